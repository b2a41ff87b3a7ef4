/* Convolutions and their gradients as blocks of sums in registers.

   A convolution is a sum of products of one number with a vector of features. A block
   of BLOCK points times two vectors is summed up in registers: that many independent
   sums hide the latency of a multiply-add, and each vector that is loaded is used BLOCK
   times. Both lengths are known to the compiler, which unrolls what loops over them.
   Features have to come in multiples of two vectors. */

#ifndef JAXIL_CONVOLUTION_BLOCKS_H
#define JAXIL_CONVOLUTION_BLOCKS_H

#include <stddef.h>
#include <stdint.h>

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

#endif
