/* An encoder's convolutions with ReLU, and their gradients, for XLA on a CPU.

   `encoding.py` defines what each function computes, with the same names and shapes.
   Arrays are channels last. Each thread passes an image through all layers, so that
   intermediate outputs stay in its cache.

   This file is the interface to XLA and distributes a batch among threads; the headers
   process one image. */

#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#include "layers.h"
#include "threads.h"
#include "xla/ffi/api/c_api.h"

#define MOST_LAYERS 8

typedef struct {
  size_t batch, count; /* images, layers */
  Layer layers[MOST_LAYERS];
  const uint8_t *pixels;
  const float *mean;
  size_t mean_size; /* 1, or the size of an image */
  float contrast;
  float *y[MOST_LAYERS];         /* outputs of the layers; NULL: not needed */
  const float *cotangent;        /* of the last one */
  float *sums;                   /* partial sums of the gradients */
  size_t num_sums, sum_size;     /* their number, and the size of one */
  size_t gradients[MOST_LAYERS]; /* offset of each layer's gradients in a sum */
  float *kernels;                /* allocated by `prepare` */
} Call;

static XLA_FFI_Error *no_memory(XLA_FFI_CallFrame *frame) {
  XLA_FFI_Error_Create_Args error = {
      .struct_size = XLA_FFI_Error_Create_Args_STRUCT_SIZE,
      .message = "no memory for an encoder's convolutions",
      .errc = XLA_FFI_Error_Code_RESOURCE_EXHAUSTED,
  };
  return frame->api->XLA_FFI_Error_Create(&error);
}

/* Returns whether XLA only asks for the interface version, after answering it. */
static int answers_metadata(XLA_FFI_CallFrame *frame) {
  /* The type's name differs between jaxlib 0.10 and 0.12. */
  const void *extension = frame->extension_start;
  if (extension == NULL || frame->extension_start->type != XLA_FFI_Extension_Metadata)
    return 0;
  XLA_FFI_Metadata *metadata =
      ((const XLA_FFI_Metadata_Extension *)extension)->metadata;
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

/* Reads pixels, mean, kernel and bias of each layer, contrast and strides. */
static Call read_call(XLA_FFI_CallFrame *frame, size_t layers) {
  const XLA_FFI_Buffer *pixels = argument(frame, 0), *mean = argument(frame, 1);
  const XLA_FFI_Scalar *contrast = frame->attrs.attrs[0]; /* sorted by name */
  const XLA_FFI_Array *strides = frame->attrs.attrs[1];
  Call call = {
      .batch = pixels->dims[0],
      .count = layers,
      .pixels = pixels->data,
      .mean = mean->data,
      .mean_size = 1,
      .contrast = *(const float *)contrast->value,
  };
  for (int64_t k = 0; k < mean->rank; k++) call.mean_size *= mean->dims[k];
  size_t height = pixels->dims[1], width = pixels->dims[2];
  for (size_t l = 0; l < layers; l++) {
    const XLA_FFI_Buffer *kernel = argument(frame, 2 + 2 * l);
    const size_t stride = ((const int64_t *)strides->data)[l];
    const size_t down = kernel->dims[0], right = kernel->dims[1];
    const Shape shape = {
        .height = height,
        .width = width,
        .channels = kernel->dims[2],
        .kernel_height = down,
        .kernel_width = right,
        .features = kernel->dims[3],
        .stride = stride,
        .out_height = (height - down) / stride + 1,
        .out_width = (width - right) / stride + 1,
    };
    call.layers[l] = make_layer(shape);
    call.layers[l].kernel = kernel->data;
    call.layers[l].bias = argument(frame, 3 + 2 * l)->data;
    height = shape.out_height;
    width = shape.out_width;
  }
  return call;
}

/* Allocates and fills transformed kernels. The backward pass flips those of all layers
   but the first. */
static int prepare(Call *call, int backward) {
  size_t size = 0;
  for (size_t l = 0; l < call->count; l++) {
    const Layer *layer = &call->layers[l];
    size += kernel_size(&layer->shape, layer->winograd);
    size += kernel_size(&layer->back, 0) + kernel_size(&layer->back, 1);
  }
  float *next = call->kernels = malloc(size * sizeof(float));
  if (next == NULL) return 0;
  for (size_t l = 0; l < call->count; l++) {
    Layer *layer = &call->layers[l];
    const float *kernel = layer->kernel;
    if (!backward && layer->winograd) {
      transform_kernel(&layer->shape, kernel, next);
      layer->kernel = next;
      next += kernel_size(&layer->shape, 1);
    }
    if (backward && l > 0) {
      flip_kernel(&layer->shape, kernel, next);
      layer->flipped = next;
      next += kernel_size(&layer->back, 0);
      if (layer->back_winograd) {
        transform_kernel(&layer->back, layer->flipped, next);
        layer->flipped = next;
        next += kernel_size(&layer->back, 1);
      }
    }
  }
  return 1;
}

/* x = contrast (pixels / 255 - mean) of one image. */
static void centre(const Call *call, size_t image, float *x) {
  const size_t size = image_size(&call->layers[0].shape);
  const uint8_t *pixels = call->pixels + image * size;
  const float *mean = call->mean, contrast = call->contrast;
  const float share = 1.0f / 255.0f; /* dividing would take as long as a layer */
  if (call->mean_size == 1) {
    for (size_t k = 0; k < size; k++) x[k] = contrast * (pixels[k] * share - *mean);
  } else {
    for (size_t k = 0; k < size; k++) x[k] = contrast * (pixels[k] * share - mean[k]);
  }
}

/* Size of the largest output of a layer. */
static size_t largest_output(const Call *call) {
  size_t most = 0;
  for (size_t l = 0; l < call->count; l++)
    most = larger(most, output_size(&call->layers[l].shape));
  return most;
}

static size_t encode_scratch(const Call *call) {
  size_t scratch = 0;
  for (size_t l = 0; l < call->count; l++)
    scratch = larger(scratch, forward_scratch(&call->layers[l]));
  return image_size(&call->layers[0].shape) + 2 * largest_output(call) + scratch;
}

static void encode_image(void *data, size_t image, float *x) {
  Call *call = data;
  const Layer *layers = call->layers;
  float *first = x + image_size(&layers[0].shape);
  float *second = first + largest_output(call), *between[] = {first, second};
  centre(call, image, x);
  const float *from = x;
  for (size_t l = 0; l < call->count; l++) {
    float *y = call->y[l] ? call->y[l] + image * output_size(&layers[l].shape)
                          : between[l % 2];
    go_forward(&layers[l], from, y, second + largest_output(call));
    from = y;
  }
}

/* pixels, mean, (kernel, bias) of each layer -> y of the last layers */
XLA_FFI_Error *jaxil_encode(XLA_FFI_CallFrame *frame) {
  if (answers_metadata(frame)) return NULL;
  Call call = read_call(frame, (frame->args.size - 2) / 2);
  const size_t wanted = frame->rets.size, first = call.count - wanted;
  for (size_t l = first; l < call.count; l++)
    call.y[l] = result(frame, l - first)->data;
  if (!prepare(&call, 0)) return no_memory(frame);
  const int done =
      for_each(call.batch, frame, encode_image, &call, encode_scratch(&call));
  free(call.kernels);
  return done ? NULL : no_memory(frame);
}

/* Images per partial sum of gradients. The number is constant and partial sums are
   added in order, so the result does not depend on the number of threads. */
#define IMAGES_PER_SUM 4

/* Size of the array for the cotangent of layer l. The first layer needs no padding,
   since pixels have no gradient. */
static size_t cotangent_size(const Layer *layer, size_t l) {
  return l ? image_size(&layer->back) : output_size(&layer->shape);
}

static Points place_cotangent(const Layer *layer, size_t l, float *array) {
  if (l == 0) return contiguous(&layer->shape, array);
  memset(array, 0, cotangent_size(layer, l) * sizeof(float));
  return inside_padding(layer, array);
}

static size_t largest_cotangent(const Call *call) {
  size_t most = 0;
  for (size_t l = 0; l < call->count; l++)
    most = larger(most, cotangent_size(&call->layers[l], l));
  return most;
}

static size_t gradient_scratch(const Call *call) {
  size_t scratch = 0;
  for (size_t l = 0; l < call->count; l++)
    scratch = larger(scratch, backward_scratch(&call->layers[l]));
  return image_size(&call->layers[0].shape) + 2 * largest_cotangent(call) + scratch;
}

/* Backpropagates the last layer's cotangent through all layers of an image. */
static void differentiate_image(const Call *call, size_t image, float *sums, float *x) {
  const Layer *layers = call->layers;
  const size_t last = call->count - 1, size = output_size(&layers[last].shape);
  float *first = x + image_size(&layers[0].shape);
  float *second = first + largest_cotangent(call), *arrays[] = {first, second};
  float *scratch = second + largest_cotangent(call), *cotangent = arrays[last % 2];
  centre(call, image, x);
  Points g = place_cotangent(&layers[last], last, cotangent);
  pass_relu(&layers[last].shape, call->y[last] + image * size,
            call->cotangent + image * size, g);
  for (size_t l = last;; l--) {
    const Layer *layer = &layers[l];
    const float *from = l ? call->y[l - 1] + image * image_size(&layer->shape) : x;
    float *kernel = sums + call->gradients[l];
    float *bias = kernel + kernel_size(&layer->shape, layer->winograd);
    add_gradients(layer, from, g, kernel, bias, scratch);
    if (l == 0) return;
    float *next = arrays[(l - 1) % 2];
    g = place_cotangent(&layers[l - 1], l - 1, next);
    go_backward(layer, cotangent, from, g, scratch);
    cotangent = next;
  }
}

static void differentiate_images(void *data, size_t part, float *scratch) {
  const Call *call = data;
  float *sums = call->sums + part * call->sum_size;
  const size_t first = part * IMAGES_PER_SUM, end = first + IMAGES_PER_SUM;
  memset(sums, 0, call->sum_size * sizeof(float));
  for (size_t image = first; image < end && image < call->batch; image++)
    differentiate_image(call, image, sums, scratch);
}

#define FLOATS_PER_SLICE 4096

static void add_up_slice(void *data, size_t slice, float *scratch) {
  const Call *call = data;
  (void)scratch;
  const size_t first = slice * FLOATS_PER_SLICE;
  size_t end = first + FLOATS_PER_SLICE;
  if (end > call->sum_size) end = call->sum_size;
  for (size_t sum = 1; sum < call->num_sums; sum++) {
    const float *addend = call->sums + sum * call->sum_size;
    for (size_t k = first; k < end; k++) call->sums[k] += addend[k];
  }
}

/* pixels, mean, (kernel, bias) of each layer, y of each layer, cotangent of the last
   -> gradients of (kernel, bias) of each layer */
XLA_FFI_Error *jaxil_encode_gradient(XLA_FFI_CallFrame *frame) {
  if (answers_metadata(frame)) return NULL;
  Call call = read_call(frame, (frame->args.size - 3) / 3);
  for (size_t l = 0; l < call.count; l++) {
    const Layer *layer = &call.layers[l];
    call.y[l] = argument(frame, 2 + 2 * call.count + l)->data;
    call.gradients[l] = call.sum_size;
    call.sum_size += kernel_size(&layer->shape, layer->winograd);
    call.sum_size += layer->shape.features;
  }
  call.cotangent = argument(frame, 2 + 3 * call.count)->data;
  /* An empty batch has one sum, of zeros. */
  call.num_sums = larger(1, (call.batch + IMAGES_PER_SUM - 1) / IMAGES_PER_SUM);
  call.sums = malloc(call.num_sums * call.sum_size * sizeof(float));
  if (call.sums == NULL || !prepare(&call, 1)) {
    free(call.sums);
    return no_memory(frame);
  }
  const size_t slices = (call.sum_size + FLOATS_PER_SLICE - 1) / FLOATS_PER_SLICE;
  const int done = for_each(call.num_sums, frame, differentiate_images, &call,
                            gradient_scratch(&call)) &&
                   for_each(slices, frame, add_up_slice, &call, 0);
  for (size_t l = 0; l < call.count; l++) {
    const Layer *layer = &call.layers[l];
    const Shape *s = &layer->shape;
    const float *sum = call.sums + call.gradients[l];
    float *kernel = result(frame, 2 * l)->data;
    if (layer->winograd)
      transform_gradient(s, sum, kernel);
    else
      memcpy(kernel, sum, kernel_size(s, 0) * sizeof(float));
    memcpy(result(frame, 2 * l + 1)->data, sum + kernel_size(s, layer->winograd),
           s->features * sizeof(float));
  }
  free(call.kernels);
  free(call.sums);
  return done ? NULL : no_memory(frame);
}
