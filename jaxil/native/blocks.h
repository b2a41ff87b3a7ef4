/* Convolutions and their gradients, accumulated in blocks of registers.

   A convolution sums products of a number with a vector of features. Sums for BLOCK
   points times two vectors are kept in registers: enough independent sums to hide the
   latency of a multiply-add, and BLOCK uses of each vector that is loaded. Both lengths
   are known at compile time, so loops over them are unrolled. The number of features
   must be a multiple of two vectors. */

#ifndef JAXIL_BLOCKS_H
#define JAXIL_BLOCKS_H

#include <stddef.h>
#include <stdint.h>

#if defined(__clang__)
#error "GCC is needed: compiled by clang, this is half as fast as XLA's convolutions"
#endif

/* 28 of 32 registers, or 12 of 16, hold sums. */
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

/* Calls FUNCTION(n, ...) with n in 1 ... BLOCK as a compile-time constant. */
#define CASE(n, FUNCTION, ...)                    \
  case n:                                         \
    FUNCTION(n < BLOCK ? n : BLOCK, __VA_ARGS__); \
    break;
#define WITH_KNOWN(n, FUNCTION, ...) \
  switch (n) {                       \
    CASE(1, FUNCTION, __VA_ARGS__)   \
    CASE(2, FUNCTION, __VA_ARGS__)   \
    CASE(3, FUNCTION, __VA_ARGS__)   \
    CASE(4, FUNCTION, __VA_ARGS__)   \
    CASE(5, FUNCTION, __VA_ARGS__)   \
    CASE(6, FUNCTION, __VA_ARGS__)   \
    CASE(7, FUNCTION, __VA_ARGS__)   \
    CASE(8, FUNCTION, __VA_ARGS__)   \
    CASE(9, FUNCTION, __VA_ARGS__)   \
    CASE(10, FUNCTION, __VA_ARGS__)  \
    CASE(11, FUNCTION, __VA_ARGS__)  \
    CASE(12, FUNCTION, __VA_ARGS__)  \
    CASE(13, FUNCTION, __VA_ARGS__)  \
    CASE(14, FUNCTION, __VA_ARGS__)  \
  }

/* A convolution of one image. */
typedef struct {
  size_t height, width, channels;               /* of the image */
  size_t kernel_height, kernel_width, features; /* of the kernel */
  size_t stride, out_height, out_width;         /* of the output */
} Shape;

/* The points of an output, which may be part of a larger array. */
typedef struct {
  float *at;
  size_t row, step; /* offsets to the next point below and to the right */
} Points;

INLINE Points contiguous(const Shape *s, float *at) {
  return (Points){at, s->out_width * s->features, s->features};
}

/* What is done with a sum; one of the two is NULL. With a bias for each feature:
   relu(sum + bias). With a gate for each sum: the sum where the gate is positive, else
   0. */
typedef struct {
  const float *bias, *gate;
} Finish;

/* NaN stays NaN, as in jax, so that divergence is noticed. */
INLINE Vector relu(Vector x) { return (Vector)((Mask)x & ~(x <= (Vector){0})); }

INLINE Vector gated(Vector x, Vector gate) {
  return (Vector)((Mask)x & (gate > (Vector){0}));
}

/* The gate is indexed by point and feature. */
INLINE Vector finished(Vector sum, const Finish *finish, size_t point, size_t feature,
                       size_t features) {
  if (finish->bias) return relu(sum + *(const Vector *)(finish->bias + feature));
  return gated(sum, *(const Vector *)(finish->gate + point * features + feature));
}

/* sums[p] = sum over u, k of x[p step + u row + k] w[u, k], for a pair of vectors. */
INLINE void sum_points(size_t n, const float *x, size_t step, size_t row, size_t rows,
                       size_t length, const float *w, size_t features, Vector *low,
                       Vector *high) {
  UNROLL
  for (size_t p = 0; p < n; p++) low[p] = high[p] = (Vector){0};
  for (size_t u = 0; u < rows; u++) {
    for (size_t k = 0; k < length; k++) {
      const Vector w_low = *(const Vector *)w, w_high = *(const Vector *)(w + LANES);
      UNROLL
      for (size_t p = 0; p < n; p++) {
        low[p] += x[u * row + p * step + k] * w_low;
        high[p] += x[u * row + p * step + k] * w_high;
      }
      w += features;
    }
  }
}

/* y[p] = finished(sums[p]); `point` is the index of the first. */
INLINE void convolve_points(size_t n, const Shape *s, const float *x, const float *w,
                            const Finish *finish, size_t point, size_t feature,
                            float *y, size_t y_step) {
  Vector low[BLOCK], high[BLOCK];
  sum_points(n, x, s->stride * s->channels, s->width * s->channels, s->kernel_height,
             s->kernel_width * s->channels, w + feature, s->features, low, high);
  UNROLL
  for (size_t p = 0; p < n; p++) {
    float *to = y + p * y_step + feature;
    *(Vector *)to = finished(low[p], finish, point + p, feature, s->features);
    *(Vector *)(to + LANES) =
        finished(high[p], finish, point + p, feature + LANES, s->features);
  }
}

/* w[k] += sum over i, j of x[i row + j step + k] g[i, j], for a pair of vectors. */
INLINE void correlate_points(size_t n, const float *x, size_t step, size_t row,
                             size_t height, size_t width, Points g, float *w,
                             size_t features) {
  Vector low[BLOCK], high[BLOCK];
  UNROLL
  for (size_t k = 0; k < n; k++) {
    low[k] = *(const Vector *)(w + k * features);
    high[k] = *(const Vector *)(w + k * features + LANES);
  }
  for (size_t i = 0; i < height; i++) {
    const float *here = x + i * row, *at = g.at + i * g.row;
    for (size_t j = 0; j < width; j++) {
      const Vector g_low = *(const Vector *)at, g_high = *(const Vector *)(at + LANES);
      UNROLL
      for (size_t k = 0; k < n; k++) {
        low[k] += here[k] * g_low;
        high[k] += here[k] * g_high;
      }
      here += step;
      at += g.step;
    }
  }
  UNROLL
  for (size_t k = 0; k < n; k++) {
    *(Vector *)(w + k * features) = low[k];
    *(Vector *)(w + k * features + LANES) = high[k];
  }
}

/* y = finished(x * w) of one image. */
static void convolve(const Shape *s, const float *x, const float *w,
                     const Finish *finish, Points y) {
  const size_t blocks = (s->out_width + BLOCK - 1) / BLOCK;
  for (size_t i = 0; i < s->out_height; i++)
    for (size_t f = 0; f < s->features; f += PAIR)
      for (size_t q = 0; q < blocks; q++) {
        const size_t j = s->out_width * q / blocks;
        const size_t n = s->out_width * (q + 1) / blocks - j;
        const float *from = x + s->stride * (i * s->width + j) * s->channels;
        WITH_KNOWN(n, convolve_points, s, from, w, finish, i * s->out_width + j, f,
                   y.at + i * y.row + j * y.step, y.step)
      }
}

/* Adds the kernel gradient of one image x, with the output's cotangent g, to w. */
static void correlate(const Shape *s, const float *x, Points g, float *w) {
  const size_t row = s->width * s->channels, step = s->stride * s->channels;
  const size_t length = s->kernel_width * s->channels;
  const size_t blocks = (length + BLOCK - 1) / BLOCK;
  for (size_t u = 0; u < s->kernel_height; u++)
    for (size_t q = 0; q < blocks; q++) {
      const size_t k = length * q / blocks, n = length * (q + 1) / blocks - k;
      for (size_t f = 0; f < s->features; f += PAIR) {
        const Points pair = {g.at + f, g.row, g.step};
        WITH_KNOWN(n, correlate_points, x + u * row + k, step, s->stride * row,
                   s->out_height, s->out_width, pair,
                   w + (u * length + k) * s->features + f, s->features)
      }
    }
}

#endif
