/* Convolution with ReLU, and its gradients, for XLA on a CPU.

   `convolution.py` says what each function computes; shapes and names are its own. All
   arrays are float32, channels last, and VALID: every window lies in its image.

   This file is XLA's side: buffers in, buffers out, images shared out to threads. What
   is done with an image is in the two headers. */

#include <sched.h>
#include <stdatomic.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#include "convolution_blocks.h"
#include "convolution_winograd.h"
#include "xla/ffi/api/c_api.h"

typedef struct {
  Shape shape;
  const float *images, *kernel, *bias, *y, *cotangent;
  float *output;
  int winograd; /* whether the kernel, or its gradient, is the transformed one */
  atomic_int out_of_memory;
} Call;

typedef void Work(Call *call, size_t part);

/* Parts of a batch that are handed out one by one. The last of its users frees it. */
typedef struct {
  Work *work;
  Call *call;
  size_t count;
  atomic_size_t next, done, users;
} Team;

static void leave(Team *team) {
  if (atomic_fetch_sub(&team->users, 1) == 1) free(team);
}

static void take_part(void *data) {
  Team *team = data;
  size_t part;
  while ((part = atomic_fetch_add(&team->next, 1)) < team->count) {
    team->work(team->call, part);
    atomic_fetch_add(&team->done, 1);
  }
  leave(team);
}

static int succeeded(XLA_FFI_CallFrame *frame, XLA_FFI_Error *error) {
  if (error == NULL) return 1;
  XLA_FFI_Error_Destroy_Args args = {
      .struct_size = XLA_FFI_Error_Destroy_Args_STRUCT_SIZE,
      .error = error,
  };
  frame->api->XLA_FFI_Error_Destroy(&args);
  return 0;
}

/* Returns how many threads XLA has; 1 where it doesn't tell. */
static size_t number_of_threads(XLA_FFI_CallFrame *frame) {
  int64_t threads = 1;
  XLA_FFI_ThreadPool_NumThreads_Args args = {
      .struct_size = XLA_FFI_ThreadPool_NumThreads_Args_STRUCT_SIZE,
      .ctx = frame->ctx,
      .num_threads = &threads,
  };
  const int known = succeeded(frame, frame->api->XLA_FFI_ThreadPool_NumThreads(&args));
  return known && threads > 1 ? (size_t)threads : 1;
}

/* Works on all parts, with the threads of XLA that are free. A thread that comes too
   late finds none left; so only parts in work are waited for, and that always ends. */
static void for_each(size_t count, XLA_FFI_CallFrame *frame, Work *work, Call *call) {
  const size_t threads = number_of_threads(frame);
  const size_t members = threads < count ? threads : count;
  Team *team = members > 1 ? malloc(sizeof(Team)) : NULL;
  if (team == NULL) {
    for (size_t part = 0; part < count; part++) work(call, part);
    return;
  }
  *team = (Team){.work = work, .call = call, .count = count};
  atomic_init(&team->users, members + 1); /* once more, for the one who waits */
  for (size_t k = 1; k < members; k++) {
    XLA_FFI_ThreadPool_Schedule_Args task = {
        .struct_size = XLA_FFI_ThreadPool_Schedule_Args_STRUCT_SIZE,
        .ctx = frame->ctx,
        .task = take_part,
        .data = team,
    };
    if (!succeeded(frame, frame->api->XLA_FFI_ThreadPool_Schedule(&task))) leave(team);
  }
  take_part(team);
  while (atomic_load(&team->done) < count) sched_yield();
  leave(team);
}

static XLA_FFI_Error *no_memory(XLA_FFI_CallFrame *frame) {
  XLA_FFI_Error_Create_Args error = {
      .struct_size = XLA_FFI_Error_Create_Args_STRUCT_SIZE,
      .message = "no memory for a convolution's gradient",
      .errc = XLA_FFI_Error_Code_RESOURCE_EXHAUSTED,
  };
  return frame->api->XLA_FFI_Error_Create(&error);
}

/* Says which interface this was compiled for, where XLA asks for no more than that. */
static int answers_metadata(XLA_FFI_CallFrame *frame) {
  /* Its type has another name in jaxlib 0.10 than in 0.12. */
  const void *extension = frame->extension_start;
  if (extension == NULL || frame->extension_start->type != XLA_FFI_Extension_Metadata)
    return 0;
  XLA_FFI_Metadata *metadata = ((const XLA_FFI_Metadata_Extension *)extension)->metadata;
  metadata->api_version.major_version = XLA_FFI_API_MAJOR;
  metadata->api_version.minor_version = XLA_FFI_API_MINOR;
  return 1;
}

static const XLA_FFI_Buffer *argument(XLA_FFI_CallFrame *frame, int k) {
  return frame->args.args[k];
}

static const XLA_FFI_Buffer *result(XLA_FFI_CallFrame *frame, int k) {
  return frame->rets.rets[k];
}

static Shape shape_of(XLA_FFI_CallFrame *frame, const XLA_FFI_Buffer *images,
                      const XLA_FFI_Buffer *kernel, const XLA_FFI_Buffer *y) {
  const XLA_FFI_Scalar *stride = frame->attrs.attrs[0];
  return (Shape){
      .batch = images->dims[0],
      .height = images->dims[1],
      .width = images->dims[2],
      .channels = images->dims[3],
      .kernel_height = kernel->dims[0],
      .kernel_width = kernel->dims[1],
      .features = kernel->dims[3],
      .stride = *(const int64_t *)stride->value,
      .out_height = y->dims[1],
      .out_width = y->dims[2],
  };
}

static size_t image_size(const Shape *s) { return s->height * s->width * s->channels; }
static size_t output_size(const Shape *s) {
  return s->out_height * s->out_width * s->features;
}
static size_t kernel_size(const Shape *s) {
  return s->kernel_height * s->kernel_width * s->channels * s->features;
}

/* Memory for one part of a batch; NULL, and the call fails, if there is none. */
static float *scratch_for(Call *call, size_t size) {
  float *scratch = malloc(size * sizeof(float));
  if (scratch == NULL) atomic_store(&call->out_of_memory, 1);
  return scratch;
}

/* y = relu(x * kernel + bias) of one image of shape s, or x * kernel without bias. */
static void convolve_either(Call *call, const Shape *s, const float *x, float *y) {
  if (!call->winograd) {
    convolve(s, x, call->kernel, call->bias, y);
    return;
  }
  float *scratch = scratch_for(call, winograd_convolve_scratch(s));
  if (scratch == NULL) return;
  winograd_convolve(s, x, call->kernel, call->bias, y, scratch);
  free(scratch);
}

static void convolve_image(Call *call, size_t image) {
  const Shape *s = &call->shape;
  convolve_either(call, s, call->images + image * image_size(s),
                  call->output + image * output_size(s));
}

/* images, kernel, bias -> y */
XLA_FFI_Error *jaxil_convolve_relu(XLA_FFI_CallFrame *frame) {
  if (answers_metadata(frame)) return NULL;
  const XLA_FFI_Buffer *images = argument(frame, 0), *kernel = argument(frame, 1);
  const XLA_FFI_Buffer *y = result(frame, 0);
  Call call = {
      .shape = shape_of(frame, images, kernel, y),
      .images = images->data,
      .kernel = kernel->data,
      .bias = argument(frame, 2)->data,
      .output = y->data,
  };
  const Shape *s = &call.shape;
  float *transformed = NULL;
  if (suits_winograd(s)) {
    transformed = malloc(ELEMENTS * s->channels * s->features * sizeof(float));
    if (transformed == NULL) return no_memory(frame);
    transform_kernel(s, kernel->data, transformed);
    call.kernel = transformed;
    call.winograd = 1;
  }
  for_each(s->batch, frame, convolve_image, &call);
  free(transformed);
  return atomic_load(&call.out_of_memory) ? no_memory(frame) : NULL;
}

/* So many images have one sum of their kernel gradients. It is a constant, and the sums
   are added up in order: the result doesn't depend on the number of threads. */
#define IMAGES_OF_A_SUM 4

/* Numbers in a sum: the gradient of the kernel, plain or transformed, and of the bias. */
static size_t gradient_size(const Call *call) {
  const Shape *s = &call->shape;
  const size_t pairs = s->channels * s->features;
  return (call->winograd ? ELEMENTS * pairs : kernel_size(s)) + s->features;
}

static void correlate_images(Call *call, size_t part) {
  const Shape *s = &call->shape;
  const size_t size = output_size(s), first = part * IMAGES_OF_A_SUM;
  const size_t end = first + IMAGES_OF_A_SUM;
  float *kernel = call->output + part * gradient_size(call);
  float *bias = kernel + gradient_size(call) - s->features;
  float *g = scratch_for(
      call, size + (call->winograd ? winograd_correlate_scratch(s) : 0));
  if (g == NULL) return;
  memset(kernel, 0, gradient_size(call) * sizeof(float));
  for (size_t image = first; image < end && image < s->batch; image++) {
    const float *x = call->images + image * image_size(s);
    pass_relu(call->y + image * size, call->cotangent + image * size, g, size);
    for (size_t p = 0; p < size; p += s->features)
      for (size_t f = 0; f < s->features; f++) bias[f] += g[p + f];
    if (call->winograd)
      winograd_correlate(s, x, g, kernel, g + size);
    else
      correlate(s, x, g, kernel);
  }
  free(g);
}

/* images, y, cotangent -> kernel's gradient, bias's gradient */
XLA_FFI_Error *jaxil_kernel_gradient(XLA_FFI_CallFrame *frame) {
  if (answers_metadata(frame)) return NULL;
  const XLA_FFI_Buffer *images = argument(frame, 0), *y = argument(frame, 1);
  const XLA_FFI_Buffer *kernel = result(frame, 0), *bias = result(frame, 1);
  Call call = {
      .shape = shape_of(frame, images, kernel, y),
      .images = images->data,
      .y = y->data,
      .cotangent = argument(frame, 2)->data,
  };
  const Shape *s = &call.shape;
  call.winograd = suits_winograd(s);
  const size_t sums = (s->batch + IMAGES_OF_A_SUM - 1) / IMAGES_OF_A_SUM;
  const size_t size = gradient_size(&call), features = s->features;
  float *total = call.output = malloc(sums * size * sizeof(float));
  if (total == NULL) return no_memory(frame);
  for_each(sums, frame, correlate_images, &call);
  for (size_t sum = 1; sum < sums; sum++)
    for (size_t k = 0; k < size; k++) total[k] += total[sum * size + k];
  if (call.winograd)
    transform_gradient(s, total, kernel->data);
  else
    memcpy(kernel->data, total, kernel_size(s) * sizeof(float));
  memcpy(bias->data, total + size - features, features * sizeof(float));
  free(total);
  return atomic_load(&call.out_of_memory) ? no_memory(frame) : NULL;
}

/* Of a convolution without stride: the one that gives the gradient of its images, which
   is one of the cotangent, framed with zeros as far as the kernel reaches. */
static Shape transposed(const Shape *s) {
  return (Shape){
      .batch = s->batch,
      .height = s->out_height + 2 * (s->kernel_height - 1),
      .width = s->out_width + 2 * (s->kernel_width - 1),
      .channels = s->features,
      .kernel_height = s->kernel_height,
      .kernel_width = s->kernel_width,
      .features = s->channels,
      .stride = 1,
      .out_height = s->height,
      .out_width = s->width,
  };
}

static void spread_image(Call *call, size_t image) {
  const Shape *s = &call->shape, back = transposed(s);
  float *framed = calloc(image_size(&back), sizeof(float));
  if (framed == NULL) {
    atomic_store(&call->out_of_memory, 1);
    return;
  }
  const size_t length = s->out_width * s->features;
  for (size_t i = 0; i < s->out_height; i++) {
    const size_t at = image * output_size(s) + i * length;
    const size_t row = i + s->kernel_height - 1, column = s->kernel_width - 1;
    pass_relu(call->y + at, call->cotangent + at,
              framed + (row * back.width + column) * s->features, length);
  }
  convolve_either(call, &back, framed, call->output + image * image_size(s));
  free(framed);
}

/* to[v, f, c] = from[last - v, c, f]: the kernel of the transposed convolution. */
static void turn_kernel(const Shape *s, const float *from, float *to) {
  const size_t window = s->kernel_height * s->kernel_width;
  for (size_t v = 0; v < window; v++)
    for (size_t c = 0; c < s->channels; c++)
      for (size_t f = 0; f < s->features; f++)
        to[((window - 1 - v) * s->features + f) * s->channels + c] =
            from[(v * s->channels + c) * s->features + f];
}

/* kernel, y, cotangent -> images' gradient, of a convolution without stride */
XLA_FFI_Error *jaxil_image_gradient(XLA_FFI_CallFrame *frame) {
  if (answers_metadata(frame)) return NULL;
  const XLA_FFI_Buffer *kernel = argument(frame, 0), *y = argument(frame, 1);
  const XLA_FFI_Buffer *images = result(frame, 0);
  Call call = {
      .shape = shape_of(frame, images, kernel, y),
      .y = y->data,
      .cotangent = argument(frame, 2)->data,
      .output = images->data,
  };
  const Shape *s = &call.shape, back = transposed(s);
  call.winograd = suits_winograd(&back);
  const size_t transformed = ELEMENTS * s->channels * s->features;
  float *turned = malloc(
      (kernel_size(s) + (call.winograd ? transformed : 0)) * sizeof(float));
  if (turned == NULL) return no_memory(frame);
  turn_kernel(s, kernel->data, turned);
  call.kernel = turned;
  if (call.winograd) {
    call.kernel = turned + kernel_size(s);
    transform_kernel(&back, turned, turned + kernel_size(s));
  }
  for_each(s->batch, frame, spread_image, &call);
  free(turned);
  return atomic_load(&call.out_of_memory) ? no_memory(frame) : NULL;
}
