/* Convolution with ReLU, and its gradients, for XLA on a CPU.

   `convolution.py` says what each function computes; shapes and names are its own. All
   arrays are float32, channels last, and VALID: every window lies in its image.

   A convolution is a sum of products of one number with a vector of features. A block
   of BLOCK points times two vectors is summed up in registers: that many independent
   sums hide the latency of a multiply-add, and each vector that is loaded is used BLOCK
   times. Both lengths are known to the compiler, which unrolls what loops over them.
   Features have to come in multiples of two vectors. */

#include <sched.h>
#include <stdatomic.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#include "xla/ffi/api/c_api.h"

#if defined(__clang__)
#error "it is for GCC: what clang makes of it is half as fast as XLA's"
#endif

/* Of 32 registers 28 are sums, of 16 registers 12. */
#if defined(__AVX512F__)
#define LANES 16
#define BLOCK 14
#elif defined(__AVX2__) && defined(__FMA__)
#define LANES 8
#define BLOCK 6
#else
#error "it is for processors with AVX2 and FMA"
#endif
#define PAIR (2 * LANES)

typedef float Vector __attribute__((vector_size(4 * LANES), aligned(4), may_alias));
typedef int32_t Mask __attribute__((vector_size(4 * LANES), aligned(4), may_alias));

#define INLINE static inline __attribute__((always_inline))
#define UNROLL _Pragma("GCC unroll 16")

/* Calls FUNCTION(n, ...) with an n that the compiler knows. */
#define WITH_KNOWN(n, FUNCTION, ...)               \
  switch (n) {                                     \
    case 1: FUNCTION(1, __VA_ARGS__); break;       \
    case 2: FUNCTION(2, __VA_ARGS__); break;       \
    case 3: FUNCTION(3, __VA_ARGS__); break;       \
    case 4: FUNCTION(4, __VA_ARGS__); break;       \
    case 5: FUNCTION(5, __VA_ARGS__); break;       \
    case 6: FUNCTION(6, __VA_ARGS__); break;       \
    case 7: FUNCTION(7, __VA_ARGS__); break;       \
    case 8: FUNCTION(8, __VA_ARGS__); break;       \
    case 9: FUNCTION(9, __VA_ARGS__); break;       \
    case 10: FUNCTION(10, __VA_ARGS__); break;     \
    case 11: FUNCTION(11, __VA_ARGS__); break;     \
    case 12: FUNCTION(12, __VA_ARGS__); break;     \
    case 13: FUNCTION(13, __VA_ARGS__); break;     \
    case 14: FUNCTION(14, __VA_ARGS__); break;     \
  }

typedef struct {
  size_t batch, height, width, channels;        /* of the images */
  size_t kernel_height, kernel_width, features; /* of the kernel */
  size_t stride, out_height, out_width;         /* of the output */
} Shape;

/* What is no number stays so, as in jax: a run that diverges has to be seen. */
INLINE Vector relu(Vector x) { return (Vector)((Mask)x & ~(x <= (Vector){0})); }

/* y[p] = sum over u, k of x[p step + u row + k] w[u, k], for a pair of vectors. */
INLINE void convolve_points(size_t n, const float *x, size_t step, size_t row,
                            size_t rows, size_t length, const float *w,
                            const float *bias, float *y, size_t features) {
  Vector low[BLOCK], high[BLOCK];
  UNROLL for (size_t p = 0; p < n; p++) {
    low[p] = bias ? *(const Vector *)bias : (Vector){0};
    high[p] = bias ? *(const Vector *)(bias + LANES) : (Vector){0};
  }
  for (size_t u = 0; u < rows; u++) {
    for (size_t k = 0; k < length; k++) {
      const Vector w_low = *(const Vector *)w, w_high = *(const Vector *)(w + LANES);
      UNROLL for (size_t p = 0; p < n; p++) {
        low[p] += x[u * row + p * step + k] * w_low;
        high[p] += x[u * row + p * step + k] * w_high;
      }
      w += features;
    }
  }
  UNROLL for (size_t p = 0; p < n; p++) {
    *(Vector *)(y + p * features) = bias ? relu(low[p]) : low[p];
    *(Vector *)(y + p * features + LANES) = bias ? relu(high[p]) : high[p];
  }
}

/* w[k] += sum over i, j of x[i row + j step + k] g[i, j], for a pair of vectors. */
INLINE void correlate_points(size_t n, const float *x, size_t step, size_t row,
                             size_t height, size_t width, const float *g, float *w,
                             size_t features) {
  Vector low[BLOCK], high[BLOCK];
  UNROLL for (size_t k = 0; k < n; k++) {
    low[k] = *(const Vector *)(w + k * features);
    high[k] = *(const Vector *)(w + k * features + LANES);
  }
  for (size_t i = 0; i < height; i++) {
    const float *here = x + i * row;
    for (size_t j = 0; j < width; j++) {
      const Vector g_low = *(const Vector *)g, g_high = *(const Vector *)(g + LANES);
      UNROLL for (size_t k = 0; k < n; k++) {
        low[k] += here[k] * g_low;
        high[k] += here[k] * g_high;
      }
      here += step;
      g += features;
    }
  }
  UNROLL for (size_t k = 0; k < n; k++) {
    *(Vector *)(w + k * features) = low[k];
    *(Vector *)(w + k * features + LANES) = high[k];
  }
}

/* y = relu(x * w + bias) of one image; without bias y = x * w. */
static void convolve(const Shape *s, const float *x, const float *w, const float *bias,
                     float *y) {
  const size_t row = s->width * s->channels, step = s->stride * s->channels;
  const size_t length = s->kernel_width * s->channels;
  const size_t blocks = (s->out_width + BLOCK - 1) / BLOCK;
  for (size_t i = 0; i < s->out_height; i++)
    for (size_t f = 0; f < s->features; f += PAIR)
      for (size_t q = 0; q < blocks; q++) {
        const size_t j = s->out_width * q / blocks;
        const size_t n = s->out_width * (q + 1) / blocks - j;
        WITH_KNOWN(n, convolve_points, x + i * s->stride * row + j * step, step, row,
                   s->kernel_height, length, w + f, bias ? bias + f : NULL,
                   y + (i * s->out_width + j) * s->features + f, s->features)
      }
}

/* w += what one image and the cotangent g of its output mean for the kernel. */
static void correlate(const Shape *s, const float *x, const float *g, float *w) {
  const size_t row = s->width * s->channels, step = s->stride * s->channels;
  const size_t length = s->kernel_width * s->channels;
  const size_t blocks = (length + BLOCK - 1) / BLOCK;
  for (size_t u = 0; u < s->kernel_height; u++)
    for (size_t q = 0; q < blocks; q++) {
      const size_t k = length * q / blocks, n = length * (q + 1) / blocks - k;
      for (size_t f = 0; f < s->features; f += PAIR)
        WITH_KNOWN(n, correlate_points, x + u * row + k, step, s->stride * row,
                   s->out_height, s->out_width, g + f,
                   w + (u * length + k) * s->features + f, s->features)
    }
}

/* g = what a cotangent of relu(z) means for z, where y = relu(z). */
INLINE void pass_relu(const float *y, const float *cotangent, float *g, size_t size) {
  for (size_t k = 0; k < size; k++) g[k] = y[k] > 0.0f ? cotangent[k] : 0.0f;
}

/* What follows is XLA's side: buffers in, buffers out, images shared out to threads. */

typedef struct {
  Shape shape;
  const float *images, *kernel, *bias, *y, *cotangent;
  float *output;
  atomic_int out_of_memory;
} Call;

typedef void Work(Call *call, size_t image);

/* Images that are handed out one by one. The last of its users frees it. */
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
  size_t image;
  while ((image = atomic_fetch_add(&team->next, 1)) < team->count) {
    team->work(team->call, image);
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

/* Works on all images, with the threads of XLA that are free. A thread that comes too
   late finds none left; so only images in work are waited for, and that always ends. */
static void for_each_image(XLA_FFI_CallFrame *frame, Work *work, Call *call) {
  const size_t count = call->shape.batch, threads = number_of_threads(frame);
  const size_t members = threads < count ? threads : count;
  Team *team = members > 1 ? malloc(sizeof(Team)) : NULL;
  if (team == NULL) {
    for (size_t image = 0; image < count; image++) work(call, image);
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

static void convolve_image(Call *call, size_t image) {
  const Shape *s = &call->shape;
  convolve(s, call->images + image * image_size(s), call->kernel, call->bias,
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
  for_each_image(frame, convolve_image, &call);
  return NULL;
}

/* Of one image: the gradients of the kernel and, behind it, of the bias. */
static void correlate_image(Call *call, size_t image) {
  const Shape *s = &call->shape;
  const size_t size = output_size(s), weights = kernel_size(s);
  float *kernel = call->output + image * (weights + s->features);
  float *bias = kernel + weights;
  float *g = malloc(size * sizeof(float));
  if (g == NULL) {
    atomic_store(&call->out_of_memory, 1);
    return;
  }
  pass_relu(call->y + image * size, call->cotangent + image * size, g, size);
  memset(kernel, 0, (weights + s->features) * sizeof(float));
  for (size_t p = 0; p < size; p += s->features)
    for (size_t f = 0; f < s->features; f++) bias[f] += g[p + f];
  correlate(s, call->images + image * image_size(s), g, kernel);
  free(g);
}

/* images, y, cotangent -> kernel's gradient, bias's gradient

   Each image has sums of its own, added up in their order: the result doesn't depend
   on the number of threads. */
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
  const size_t weights = kernel_size(&call.shape), features = call.shape.features;
  call.output = malloc(call.shape.batch * (weights + features) * sizeof(float));
  if (call.output == NULL) return no_memory(frame);
  for_each_image(frame, correlate_image, &call);
  memset(kernel->data, 0, weights * sizeof(float));
  memset(bias->data, 0, features * sizeof(float));
  const float *part = call.output;
  for (size_t image = 0; image < call.shape.batch; image++) {
    for (size_t k = 0; k < weights; k++) ((float *)kernel->data)[k] += *part++;
    for (size_t f = 0; f < features; f++) ((float *)bias->data)[f] += *part++;
  }
  free(call.output);
  return atomic_load(&call.out_of_memory) ? no_memory(frame) : NULL;
}

/* Of one image: the cotangent, with a border of zeros as wide as the kernel reaches,
   convolved with the kernel turned around. */
static void spread_image(Call *call, size_t image) {
  const Shape *s = &call->shape;
  const size_t down = s->kernel_height - 1, right = s->kernel_width - 1;
  const Shape back = {
      .height = s->out_height + 2 * down,
      .width = s->out_width + 2 * right,
      .channels = s->features,
      .kernel_height = s->kernel_height,
      .kernel_width = s->kernel_width,
      .features = s->channels,
      .stride = 1,
      .out_height = s->height,
      .out_width = s->width,
  };
  float *framed = calloc(image_size(&back), sizeof(float));
  if (framed == NULL) {
    atomic_store(&call->out_of_memory, 1);
    return;
  }
  const size_t length = s->out_width * s->features;
  for (size_t i = 0; i < s->out_height; i++) {
    const size_t at = image * output_size(s) + i * length;
    pass_relu(call->y + at, call->cotangent + at,
              framed + ((i + down) * back.width + right) * s->features, length);
  }
  convolve(&back, framed, call->kernel, NULL, call->output + image * image_size(s));
  free(framed);
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
  const Shape *s = &call.shape;
  const size_t window = s->kernel_height * s->kernel_width;
  float *turned = malloc(kernel_size(s) * sizeof(float));
  if (turned == NULL) return no_memory(frame);
  for (size_t v = 0; v < window; v++)
    for (size_t c = 0; c < s->channels; c++)
      for (size_t f = 0; f < s->features; f++)
        turned[((window - 1 - v) * s->features + f) * s->channels + c] =
            ((float *)kernel->data)[(v * s->channels + c) * s->features + f];
  call.kernel = turned;
  for_each_image(frame, spread_image, &call);
  free(turned);
  return atomic_load(&call.out_of_memory) ? no_memory(frame) : NULL;
}
