/* Winograd's convolution with 3x3 kernels: 4 products instead of 9 per output.

   A tile of 4x4 points of the image gives 2x2 points of the output:

       Y = A' [(G k G') * (B' X B)] A,   * elementwise, summed over channels

   (Lavin and Gray, 2016, arXiv 1509.09308, F(2x2, 3x3)). Each of the 16 elements is the
   product of a tiles x channels with a channels x features matrix. The gradient of the
   kernel is the transpose:

       dk = G' [sum over tiles of (B' X B) * (A dY A')] G

   All factors are 1 or 1/2, and sums have 32 terms instead of 288, so rounding errors
   are no larger than those of the direct sum. */

#ifndef JAXIL_WINOGRAD_H
#define JAXIL_WINOGRAD_H

#include "blocks.h"

#define SIDE 4 /* of a tile of the image; 2 for the output */
#define ELEMENTS (SIDE * SIDE)

/* y = B' x, for vectors `step` apart. */
INLINE void image_transform(const Vector *x, Vector *y, size_t step) {
  y[0] = x[0] - x[2 * step];
  y[step] = x[step] + x[2 * step];
  y[2 * step] = x[2 * step] - x[step];
  y[3 * step] = x[step] - x[3 * step];
}

/* y = A' x */
INLINE void output_transform(const Vector *x, Vector *y, size_t step) {
  y[0] = x[0] + x[step] + x[2 * step];
  y[step] = x[step] - x[2 * step] - x[3 * step];
}

/* y = A x */
INLINE void cotangent_transform(const Vector *x, Vector *y, size_t step) {
  y[0] = x[0];
  y[step] = x[0] + x[step];
  y[2 * step] = x[0] - x[step];
  y[3 * step] = -x[step];
}

/* y = G x */
INLINE void kernel_transform(const Vector *x, Vector *y, size_t step) {
  const Vector even = 0.5f * (x[0] + x[2 * step]), odd = 0.5f * x[step];
  y[0] = x[0];
  y[step] = even + odd;
  y[2 * step] = even - odd;
  y[3 * step] = x[2 * step];
}

/* y = G' x */
INLINE void gradient_transform(const Vector *x, Vector *y, size_t step) {
  const Vector even = 0.5f * (x[step] + x[2 * step]);
  y[0] = x[0] + even;
  y[step] = 0.5f * (x[step] - x[2 * step]);
  y[2 * step] = even + x[3 * step];
}

/* y = T x T', where T maps n vectors to m: columns first, then rows. Both arrays have
   rows of SIDE vectors. */
#define TRANSFORM(T, n, m, x, y)                                          \
  do {                                                                    \
    Vector half[SIDE][SIDE];                                              \
    UNROLL                                                                \
    for (size_t j_ = 0; j_ < (n); j_++) T(&x[0][j_], &half[0][j_], SIDE); \
    UNROLL                                                                \
    for (size_t i_ = 0; i_ < (m); i_++) T(half[i_], y[i_], 1);            \
  } while (0)

/* A tile, by its first output point. If the output's height or width is odd, the last
   tile starts one point early and repeats `again` rows or columns of another. */
typedef struct {
  size_t i, j, i_again, j_again;
} Tile;

static inline size_t halves(size_t n) { return (n + 1) / 2; }

INLINE Tile tile_at(const Shape *s, size_t index) {
  const size_t across = halves(s->out_width);
  const size_t i = index / across * 2, j = index % across * 2;
  const size_t i_again = i + 2 > s->out_height, j_again = j + 2 > s->out_width;
  return (Tile){i - i_again, j - j_again, i_again, j_again};
}

static size_t count_tiles(const Shape *s) {
  return halves(s->out_height) * halves(s->out_width);
}

/* Whether a convolution and its kernel gradient can be computed in this form. */
static int suits_winograd(const Shape *s) {
  return s->kernel_height == 3 && s->kernel_width == 3 && s->stride == 1 &&
         s->channels % PAIR == 0 && s->out_height >= 2 && s->out_width >= 2;
}

/* u[element, c, f] = (G k G')[element] of k[3, 3, c, f] */
static void transform_kernel(const Shape *s, const float *kernel, float *u) {
  const size_t size = s->channels * s->features;
  for (size_t k = 0; k < size; k += LANES) {
    Vector x[SIDE][SIDE], y[SIDE][SIDE];
    UNROLL
    for (size_t v = 0; v < 9; v++)
      x[v / 3][v % 3] = *(const Vector *)(kernel + v * size + k);
    TRANSFORM(kernel_transform, 3, SIDE, x, y);
    UNROLL
    for (size_t e = 0; e < ELEMENTS; e++)
      *(Vector *)(u + e * size + k) = y[e / SIDE][e % SIDE];
  }
}

/* dk[3, 3, c, f] = (G' u G)[c, f] */
static void transform_gradient(const Shape *s, const float *u, float *gradient) {
  const size_t size = s->channels * s->features;
  for (size_t k = 0; k < size; k += LANES) {
    Vector x[SIDE][SIDE], y[SIDE][SIDE];
    UNROLL
    for (size_t e = 0; e < ELEMENTS; e++)
      x[e / SIDE][e % SIDE] = *(const Vector *)(u + e * size + k);
    TRANSFORM(gradient_transform, SIDE, 3, x, y);
    UNROLL
    for (size_t v = 0; v < 9; v++)
      *(Vector *)(gradient + v * size + k) = y[v / 3][v % 3];
  }
}

/* points[element, c] = (B' X B)[element] of one tile; elements are `step` apart. */
INLINE void transform_tile(const Shape *s, const float *x, Tile tile, float *points,
                           size_t step) {
  const float *from = x + (tile.i * s->width + tile.j) * s->channels;
  for (size_t c = 0; c < s->channels; c += LANES) {
    Vector d[SIDE][SIDE], e[SIDE][SIDE];
    UNROLL
    for (size_t k = 0; k < ELEMENTS; k++)
      d[k / SIDE][k % SIDE] =
          *(const Vector *)(from + (k / SIDE * s->width + k % SIDE) * s->channels + c);
    TRANSFORM(image_transform, SIDE, SIDE, d, e);
    UNROLL
    for (size_t k = 0; k < ELEMENTS; k++)
      *(Vector *)(points + k * step + c) = e[k / SIDE][k % SIDE];
  }
}

/* y[i, j, f] = finished((A' sums A)[i, j]) of one tile. */
INLINE void finish_tile(const Shape *s, const float *sums, size_t step, Tile tile,
                        const Finish *finish, Points y) {
  for (size_t f = 0; f < s->features; f += LANES) {
    Vector d[SIDE][SIDE], e[2][SIDE];
    UNROLL
    for (size_t k = 0; k < ELEMENTS; k++)
      d[k / SIDE][k % SIDE] = *(const Vector *)(sums + k * step + f);
    TRANSFORM(output_transform, SIDE, 2, d, e);
    UNROLL
    for (size_t k = 0; k < 4; k++) {
      const size_t i = tile.i + k / 2, j = tile.j + k % 2;
      *(Vector *)(y.at + i * y.row + j * y.step + f) =
          finished(e[k / 2][k % 2], finish, i * s->out_width + j, f, s->features);
    }
  }
}

/* points[element, f] = (A dY A')[element] of one tile. */
INLINE void transform_cotangent(const Shape *s, Points g, Tile tile, float *points,
                                size_t step) {
  const float *from = g.at + tile.i * g.row + tile.j * g.step;
  for (size_t f = 0; f < s->features; f += LANES) {
    Vector d[2][SIDE], e[SIDE][SIDE];
    UNROLL
    for (size_t k = 0; k < 4; k++) {
      const int again = k / 2 < tile.i_again || k % 2 < tile.j_again;
      const float *at = from + k / 2 * g.row + k % 2 * g.step + f;
      d[k / 2][k % 2] = again ? (Vector){0} : *(const Vector *)at;
    }
    TRANSFORM(cotangent_transform, 2, SIDE, d, e);
    UNROLL
    for (size_t k = 0; k < ELEMENTS; k++)
      *(Vector *)(points + k * step + f) = e[k / SIDE][k % SIDE];
  }
}

/* Prefetches part k of n of an array. Tiles are read and written in bursts between the
   products; without this the core would wait for memory in each burst. */
INLINE void prefetch(const float *array, size_t size, size_t k, size_t n) {
  const size_t line = 64 / sizeof(float);
  for (size_t p = size * k / n; p < size * (k + 1) / n; p += line)
    __builtin_prefetch(array + p, 0, 2);
}

/* Scratch that `winograd_convolve` needs, in floats: a block of tiles. */
static size_t winograd_convolve_scratch(const Shape *s) {
  return ELEMENTS * BLOCK * (s->channels + s->features);
}

/* sums[p, f] of one element: points [n, channels] times w [channels, features]. */
INLINE void multiply_points(size_t n, const Shape *s, const float *points,
                            const float *w, float *sums) {
  Vector low[BLOCK], high[BLOCK];
  sum_points(n, points, s->channels, 0, 1, s->channels, w, s->features, low, high);
  UNROLL
  for (size_t p = 0; p < n; p++) {
    *(Vector *)(sums + p * s->features) = low[p];
    *(Vector *)(sums + p * s->features + LANES) = high[p];
  }
}

/* y = finished(x * k) of one image; u is the transformed kernel. */
static void winograd_convolve(const Shape *s, const float *x, const float *u,
                              const Finish *finish, Points y, float *scratch) {
  const size_t tiles = count_tiles(s), blocks = (tiles + BLOCK - 1) / BLOCK;
  const size_t step = BLOCK * s->channels, sums_step = BLOCK * s->features;
  const size_t row = s->width * s->channels, pairs = s->channels * s->features;
  /* With one pair of channels, the inputs have been read when the sums are written.
     Overwriting them halves the use of the cache. */
  const int in_place = s->features == PAIR && s->channels == PAIR;
  float *sums = in_place ? scratch : scratch + ELEMENTS * step;
  for (size_t q = 0; q < blocks; q++) {
    const size_t t = tiles * q / blocks, n = tiles * (q + 1) / blocks - t;
    for (size_t p = 0; p < n; p++)
      transform_tile(s, x, tile_at(s, t + p), scratch + p * s->channels, step);
    for (size_t e = 0; e < ELEMENTS; e++) {
      const size_t part = (q + 1) * ELEMENTS + e, parts = blocks * ELEMENTS;
      prefetch(x + SIDE * row, s->height * row, part, parts);
      prefetch(y.at + y.row, s->out_height * y.row, part, parts);
      for (size_t f = 0; f < s->features; f += PAIR)
        WITH_KNOWN(n, multiply_points, s, scratch + e * step, u + e * pairs + f,
                   sums + e * sums_step + f)
    }
    for (size_t p = 0; p < n; p++)
      finish_tile(s, sums + p * s->features, sums_step, tile_at(s, t + p), finish, y);
  }
}

/* Tiles between two loads of each sum: as many as fit in a core's own cache. Not a
   power of two, or all elements would map to the same cache lines. */
#define TILES 60

static size_t winograd_correlate_scratch(const Shape *s) {
  return ELEMENTS * TILES * (s->channels + s->features);
}

/* Adds the gradient of the transformed kernel for one image x, with the output's
   cotangent g, to u[element, c, f]. */
static void winograd_correlate(const Shape *s, const float *x, Points g, float *u,
                               float *scratch) {
  const size_t tiles = count_tiles(s), parts = (tiles + TILES - 1) / TILES;
  const size_t step = TILES * s->channels, g_step = TILES * s->features;
  float *cotangents = scratch + ELEMENTS * step;
  const size_t blocks = (s->channels + BLOCK - 1) / BLOCK;
  const size_t row = s->width * s->channels;
  for (size_t q = 0; q < parts; q++) {
    const size_t t = tiles * q / parts, n = tiles * (q + 1) / parts - t;
    for (size_t p = 0; p < n; p++) {
      const Tile tile = tile_at(s, t + p);
      transform_tile(s, x, tile, scratch + p * s->channels, step);
      transform_cotangent(s, g, tile, cotangents + p * s->features, g_step);
    }
    for (size_t e = 0; e < ELEMENTS; e++)
      for (size_t b = 0; b < blocks; b++) {
        const size_t c = s->channels * b / blocks;
        const size_t m = s->channels * (b + 1) / blocks - c;
        prefetch(x + SIDE * row, s->height * row, ((q + 1) * ELEMENTS + e) * blocks + b,
                 parts * ELEMENTS * blocks);
        for (size_t f = 0; f < s->features; f += PAIR) {
          const Points pair = {cotangents + e * g_step + f, 0, s->features};
          WITH_KNOWN(m, correlate_points, scratch + e * step + c, s->channels, 0, 1, n,
                     pair, u + (e * s->channels + c) * s->features + f, s->features)
        }
      }
  }
}

#endif
