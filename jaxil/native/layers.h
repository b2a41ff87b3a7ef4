/* The forward and backward pass of each layer, for one image. */

#ifndef JAXIL_LAYERS_H
#define JAXIL_LAYERS_H

#include <string.h>

#include "blocks.h"
#include "winograd.h"

/* A convolution, and `back`, which computes its image gradient: the convolution of the
   cotangent, padded with zeros, with the flipped kernel. */
typedef struct {
  Shape shape, back;
  int winograd, back_winograd;   /* whether Winograd's form is used */
  const float *kernel, *flipped; /* transformed if so */
  const float *bias;
} Layer;

static size_t image_size(const Shape *s) { return s->height * s->width * s->channels; }

static size_t output_size(const Shape *s) {
  return s->out_height * s->out_width * s->features;
}

static size_t kernel_size(const Shape *s, int winograd) {
  const size_t window = winograd ? ELEMENTS : s->kernel_height * s->kernel_width;
  return window * s->channels * s->features;
}

static size_t larger(size_t a, size_t b) { return a > b ? a : b; }

static Layer make_layer(Shape s) {
  const Shape back = {
      .height = s.height + s.kernel_height - 1,
      .width = s.width + s.kernel_width - 1,
      .channels = s.features,
      .kernel_height = s.kernel_height,
      .kernel_width = s.kernel_width,
      .features = s.channels,
      .stride = 1,
      .out_height = s.height,
      .out_width = s.width,
  };
  return (Layer){
      .shape = s,
      .back = back,
      .winograd = suits_winograd(&s),
      .back_winograd = suits_winograd(&back),
  };
}

/* The points of a layer's cotangent in its padded array: spaced by the stride, inside
   a border that is as wide as the kernel reaches. */
static Points inside_padding(const Layer *layer, float *padded) {
  const Shape *s = &layer->shape, *back = &layer->back;
  const size_t row = back->width * back->channels;
  return (Points){
      .at = padded + (s->kernel_height - 1) * row +
            (s->kernel_width - 1) * back->channels,
      .row = s->stride * row,
      .step = s->stride * back->channels,
  };
}

/* to[v, f, c] = from[last - v, c, f] */
static void flip_kernel(const Shape *s, const float *from, float *to) {
  const size_t window = s->kernel_height * s->kernel_width;
  for (size_t v = 0; v < window; v++)
    for (size_t f = 0; f < s->features; f++)
      for (size_t c = 0; c < s->channels; c++)
        *to++ = from[((window - 1 - v) * s->channels + c) * s->features + f];
}

/* Scratch that a layer needs, in floats. */
static size_t forward_scratch(const Layer *layer) {
  return layer->winograd ? winograd_convolve_scratch(&layer->shape) : 0;
}

static size_t backward_scratch(const Layer *layer) {
  const size_t own = layer->winograd ? winograd_correlate_scratch(&layer->shape) : 0;
  const size_t back =
      layer->back_winograd ? winograd_convolve_scratch(&layer->back) : 0;
  return larger(own, back);
}

/* y = relu(x * kernel + bias) */
static void go_forward(const Layer *layer, const float *x, float *y, float *scratch) {
  const Shape *s = &layer->shape;
  const Finish finish = {.bias = layer->bias};
  const Points points = contiguous(s, y);
  if (layer->winograd)
    winograd_convolve(s, x, layer->kernel, &finish, points, scratch);
  else
    convolve(s, x, layer->kernel, &finish, points);
}

/* Adds the gradients of kernel and bias, where g is the cotangent of x * kernel + bias.
 */
static void add_gradients(const Layer *layer, const float *x, Points g, float *kernel,
                          float *bias, float *scratch) {
  const Shape *s = &layer->shape;
  for (size_t i = 0; i < s->out_height; i++)
    for (size_t j = 0; j < s->out_width; j++) {
      const float *at = g.at + i * g.row + j * g.step;
      for (size_t f = 0; f < s->features; f++) bias[f] += at[f];
    }
  if (layer->winograd)
    winograd_correlate(s, x, g, kernel, scratch);
  else
    correlate(s, x, g, kernel);
}

/* Computes the cotangent of the previous layer before its ReLU, whose output is x, from
   the padded cotangent of this one. */
static void go_backward(const Layer *layer, const float *padded, const float *x,
                        Points g, float *scratch) {
  const Finish finish = {.gate = x};
  if (layer->back_winograd)
    winograd_convolve(&layer->back, padded, layer->flipped, &finish, g, scratch);
  else
    convolve(&layer->back, padded, layer->flipped, &finish, g);
}

/* g = the cotangent of z, given that of y = relu(z). */
static void pass_relu(const Shape *s, const float *y, const float *cotangent,
                      Points g) {
  for (size_t i = 0; i < s->out_height; i++)
    for (size_t j = 0; j < s->out_width; j++) {
      const size_t from = (i * s->out_width + j) * s->features;
      float *to = g.at + i * g.row + j * g.step;
      for (size_t f = 0; f < s->features; f++)
        to[f] = y[from + f] > 0.0f ? cotangent[from + f] : 0.0f;
    }
}

#endif
