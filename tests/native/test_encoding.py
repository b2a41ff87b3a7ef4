"""The encoder in C against its layers, one after the other, as XLA computes them."""

import functools
import pathlib
from concurrent import futures
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxil.machine import cache
from jaxil.maths import convolution
from jaxil.native import build, encoding
from jaxil.native.encoding import Weights
from tests.processes import run_python

FEATURES = encoding.FEATURES
LEARNER = ((3, 32, 2), (3, 32, 1), (3, 32, 1), (3, 32, 1))  # the paper's
TINY = ((4, 32, 4), (3, 32, 1), (3, 32, 1))


@pytest.fixture(scope="module", autouse=True)
def _it_is_compiled():
    assert build.problem() is None


def reference(pixels, mean, weights, *, contrast, strides):
    x = contrast * (
        pixels.astype(jnp.float32) / 255.0
        - jnp.broadcast_to(mean, pixels.shape[1:])[None]
    )
    for (kernel, bias), stride in zip(weights, strides, strict=True):
        x = jax.nn.relu(
            convolution.convolve(x, kernel, stride) + bias[None, None, None]
        )
    return x


def draw(seed, shape, layers):
    """Returns pixels, a mean image, weights and strides.

    Args:
      shape: of the pixels.
      layers: of each layer (height, width) of its kernel or a side, features, stride.
    """
    rng = np.random.default_rng(seed)
    pixels = jnp.asarray(rng.integers(0, 256, shape), jnp.uint8)
    mean = jnp.asarray(rng.uniform(size=shape[1:]), jnp.float32)
    weights, channels = [], shape[3]
    for size, features, _ in layers:
        size = (size, size) if isinstance(size, int) else size
        scale = np.sqrt(2.0 / (size[0] * size[1] * channels))
        kernel = rng.normal(scale=scale, size=(*size, channels, features))
        bias = rng.normal(scale=0.1, size=features)
        weights.append(
            Weights(jnp.asarray(kernel, jnp.float32), jnp.asarray(bias, jnp.float32))
        )
        channels = features
    return pixels, mean, weights, tuple(stride for *_, stride in layers)


def value_and_gradients(form, pixels, mean, weights, strides, contrast=1.5):
    def run(weights):
        return form(pixels, mean, weights, contrast=contrast, strides=strides)

    value, transpose = jax.vjp(run, weights)
    # Any cotangent will do that differs from place to place.
    places = jnp.arange(value.size, dtype=jnp.float32).reshape(value.shape)
    return value, *jax.tree.leaves(transpose(1.1 + jnp.sin(17.0 * places)))


def assert_same(drawn, tolerance=2e-5):
    pixels, mean, weights, strides = drawn
    results, expected = (
        jax.jit(lambda *x, f=form: value_and_gradients(f, *x, strides=strides))(
            pixels, mean, weights
        )
        for form in (encoding.encode, reference)
    )
    for ours, theirs in zip(results, expected, strict=True):
        assert ours.shape == theirs.shape
        scale = float(jnp.max(jnp.abs(theirs))) + 1e-3
        np.testing.assert_allclose(ours / scale, theirs / scale, atol=tolerance)


class ByHandTest(chex.TestCase):
    def test_value_and_gradients_of_one_row(self):
        # One row of 3 pixels, a kernel of 2: of feature f it is (f, 1), its bias -12.
        f = jnp.arange(FEATURES, dtype=jnp.float32)
        kernel = jnp.stack([f, jnp.ones(FEATURES)]).reshape(1, 2, 1, FEATURES)
        weights = [Weights(kernel, jnp.full(FEATURES, -12.0))]
        pixels = jnp.asarray([1, 2, 3], jnp.uint8).reshape(1, 1, 3, 1)

        def run(weights):
            return encoding.encode(
                pixels, jnp.float32(0.0), weights, contrast=255.0, strides=(1,)
            )

        both: Any = jax.jit(
            lambda w: jax.vjp(run, w)[1](jnp.ones((1, 1, 2, FEATURES)))[0]
        )
        # 1 f + 2 - 12 and 2 f + 3 - 12: open from f = 11 and from f = 5 on.
        first, second = jnp.maximum(f - 10, 0), jnp.maximum(2 * f - 9, 0)
        np.testing.assert_allclose(
            run(weights)[0, 0], jnp.stack([first, second]), atol=1e-5
        )
        ((to_kernel, to_bias),) = both(weights)
        opens = np.stack([np.arange(FEATURES) >= 11, np.arange(FEATURES) >= 5])
        np.testing.assert_array_equal(to_bias, opens.sum(0))
        np.testing.assert_allclose(to_kernel[0, 0, 0], 1 * opens[0] + 2 * opens[1])
        np.testing.assert_allclose(
            to_kernel[0, 1, 0], 2 * opens[0] + 3 * opens[1], rtol=1e-6
        )

    def test_a_3x3_kernel_in_winograds_form(self):
        # Of ones, on ones: 9 for each of the first layer's 32 features, which are 1.
        ones = Weights(jnp.ones((3, 3, FEATURES, FEATURES)), jnp.zeros(FEATURES))
        unit = Weights(jnp.ones((1, 1, 1, FEATURES)), jnp.zeros(FEATURES))
        pixels = jnp.full((1, 5, 7, 1), 255, jnp.uint8)

        def run(weights):
            return encoding.encode(
                pixels, jnp.float32(0.0), weights, contrast=1.0, strides=(1, 1)
            )

        value, transpose = jax.vjp(run, [unit, ones])
        np.testing.assert_array_equal(value, np.full((1, 3, 5, FEATURES), 9.0 * 32))
        ((to_unit, _), (to_ones, to_bias)) = transpose(jnp.ones_like(value))[0]
        # Each of 9 weights meets all 15 windows; of the first layer's points the inner
        # ones are in 9 windows, 15 * 9 in all, each 32 times.
        np.testing.assert_array_equal(to_ones, np.full(to_ones.shape, 15.0))
        np.testing.assert_array_equal(to_bias, np.full(FEATURES, 15.0))
        np.testing.assert_array_equal(to_unit, np.full(to_unit.shape, 15.0 * 9 * 32))


@settings(derandomize=True, max_examples=12, deadline=None)
@given(data=st.data())
def test_value_and_gradients_of_any_encoder(data):
    layers, height, width = [], 1, 1
    for _ in range(data.draw(st.integers(1, 3), "layers")):
        size = data.draw(st.tuples(st.integers(1, 5), st.integers(1, 5)), "kernel")
        size = data.draw(st.sampled_from([size, (3, 3)]), "kernel or 3x3")
        features = data.draw(st.sampled_from([32, 64]), "features")
        layers.append((size, features, data.draw(st.sampled_from([1, 2, 4]), "stride")))
    for size, _, stride in reversed(layers):  # the smallest image that leaves a point
        height, width = (stride * (n - 1) + k for n, k in zip((height, width), size))
    height += data.draw(st.integers(0, 12))
    width += data.draw(st.integers(0, 12))
    channels = data.draw(st.sampled_from([1, 3, 9, 32]), "channels")
    batch = data.draw(st.integers(1, 9), "batch")
    seed = data.draw(st.integers(0, 99), "seed")
    # Where a sum is 0 but for rounding, ReLU may open in one and not in the other.
    assert_same(draw(seed, (batch, height, width, channels), layers), tolerance=2e-4)


@pytest.mark.parametrize(
    ("side", "layers"), [(84, LEARNER), (48, TINY), (21, ((3, 64, 2), (3, 32, 2)))]
)
def test_encoders_of_the_presets(side, layers):
    # 7 images: two sums of gradients, the second of three images.
    assert_same(draw(0, (7, side, side, 9), layers), tolerance=1e-4)


def test_as_many_layers_as_it_takes():
    drawn = draw(7, (2, 5, 6, 3), ((2, 32, 1), *[(1, 32, 1)] * 7))
    assert len(drawn[2]) == encoding.MOST_LAYERS
    assert_same(drawn, tolerance=1e-4)
    one_more = [*drawn[2], drawn[2][-1]]
    with pytest.raises(AssertionError):
        encoding.encode(*drawn[:2], one_more, contrast=1.0, strides=(1,) * 9)


def test_a_mean_of_one_number():
    pixels, _, weights, strides = draw(1, (3, 20, 21, 3), ((4, 32, 2), (3, 32, 1)))
    assert_same((pixels, jnp.full((), 0.5), weights, strides))
    assert_same((pixels, jnp.full((1, 1, 1), 0.5), weights, strides))


def test_an_empty_batch_has_gradients_of_zero():
    drawn = draw(8, (0, 9, 9, 3), ((3, 32, 1), (3, 32, 1)))
    value, *gradients = value_and_gradients(encoding.encode, *drawn)
    assert value.shape == (0, 5, 5, 32)
    for gradient in gradients:
        np.testing.assert_array_equal(gradient, np.zeros_like(gradient))


def test_each_image_of_a_vmapped_batch_is_encoded():
    pixels, mean, weights, strides = draw(2, (3, 9, 8, 2), ((3, 32, 1), (3, 32, 1)))
    form = functools.partial(
        encoding.encode, mean=mean, weights=weights, contrast=1.0, strides=strides
    )
    rows = jax.vmap(form)(pixels[:, None])
    np.testing.assert_allclose(rows[:, 0], form(pixels), atol=1e-6)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("size", [2, 3])
def test_what_is_not_finite_is_not_hidden(size, value):
    # One weight of the second layer is not finite; 3x3 go Winograd's way.
    drawn = draw(3, (2, 12, 12, 3), ((3, 32, 1), (size, 64, 1), (size, 32, 1)))
    pixels, mean, weights, strides = drawn
    kernel = weights[1].kernel.at[0, 1, 2, 3].set(value)
    weights[1] = weights[1]._replace(kernel=kernel)
    results, expected = (
        value_and_gradients(form, pixels, mean, weights, strides)
        for form in (encoding.encode, reference)
    )
    for ours, theirs in zip(results, expected, strict=True):
        # Winograd's form makes NaN of infinity, and spreads it over a tile.
        assert not np.isfinite(ours[~np.isfinite(theirs)]).any()
    assert not np.isfinite(results[0]).all()


def test_images_do_not_see_each_other():
    pixels, mean, weights, strides = draw(4, (6, 21, 26, 3), TINY)
    form = functools.partial(encoding.encode, contrast=1.0, strides=strides)
    together = form(pixels, mean, weights)
    for k in range(6):
        np.testing.assert_array_equal(
            form(pixels[k : k + 1], mean, weights), together[k : k + 1]
        )


def test_gradients_are_those_of_finite_differences():
    # Independent of XLA's gradients; where the step crosses a ReLU's edge they differ.
    pixels, mean, weights, strides = draw(5, (2, 13, 12, 3), ((3, 32, 2), (3, 32, 1)))

    def loss(weights):
        y = encoding.encode(pixels, mean, weights, contrast=1.0, strides=strides)
        return jnp.sum(jnp.square(y))

    gradient = jax.grad(loss)(weights)
    rng = np.random.default_rng(5)
    direction = jax.tree.map(
        lambda leaf: jnp.asarray(rng.normal(size=leaf.shape), jnp.float32), weights
    )
    step = 1e-3

    def moved(sign):
        return loss(jax.tree.map(lambda w, d: w + sign * step * d, weights, direction))

    numeric = float(moved(1.0) - moved(-1.0)) / (2.0 * step)
    exact = sum(
        float(jnp.sum(g * d))
        for g, d in zip(jax.tree.leaves(gradient), jax.tree.leaves(direction))
    )
    assert exact == pytest.approx(numeric, rel=1e-2)


def test_calls_at_the_same_time_do_not_disturb_each_other():
    pixels, mean, weights, strides = draw(6, (16, 24, 24, 3), TINY)
    run = jax.jit(lambda *x: value_and_gradients(encoding.encode, *x, strides=strides))
    expected = [np.asarray(x) for x in run(pixels, mean, weights)]
    with futures.ThreadPoolExecutor(6) as pool:
        for results in pool.map(lambda _: run(pixels, mean, weights), range(60)):
            for result, known in zip(results, expected, strict=True):
                np.testing.assert_array_equal(result, known)


@pytest.mark.parametrize(
    "wrong",
    [
        lambda p, m, w: (p[0], m, w),
        lambda p, m, w: (p[:, :4], m[:4], w),
        lambda p, m, w: (p.astype(jnp.float32), m, w),
        lambda p, m, w: (p, m[:3], w),
        lambda p, m, w: (p, m, w[:1]),
        lambda p, m, w: (p, m, w[::-1]),
        lambda p, m, w: (p, m, [w[0], Weights(w[1].kernel[..., :33], w[1].bias[:33])]),
    ],
    ids=[
        "no batch",
        "too small",
        "floats",
        "mean",
        "a layer less",
        "order",
        "33 features",
    ],
)
def test_rejects_what_does_not_fit(wrong):
    pixels, mean, weights, _ = draw(0, (2, 9, 9, 2), ((3, 32, 1), (3, 64, 1)))
    wrong_pixels, wrong_mean, wrong_weights = wrong(pixels, mean, weights)
    with pytest.raises(AssertionError):
        encoding.encode(
            wrong_pixels, wrong_mean, wrong_weights, contrast=1.0, strides=(1, 1)
        )


DRAWN = """
import ctypes, hashlib, os, pathlib, sys
cores = sorted(os.sched_getaffinity(0))
os.sched_setaffinity(0, cores[:int(sys.argv[1])])
import jax, numpy as np
from jaxil.native import build
from jaxil.maths import convolution
from jaxil.native import encoding
rng = np.random.default_rng(0)
pixels = rng.integers(0, 256, (11, 27, 31, 9)).astype(np.uint8)
mean = np.float32(0.5)
weights = [
    encoding.Weights(rng.normal(scale=0.1, size=s).astype("f"), np.zeros(s[3], "f"))
    for s in [(3, 3, 9, 64), (3, 3, 64, 32), (2, 3, 32, 64)]
]
def both(form):
    value, transpose = jax.vjp(jax.jit(form), weights)
    cotangent = np.sin(np.arange(value.size, dtype="f")).reshape(value.shape)
    return value, *jax.tree.leaves(transpose(cotangent))
def ours(weights):
    return encoding.encode(pixels, mean, weights, contrast=1.0, strides=(2, 1, 1))
"""

HASHES = """
assert build.problem() is None
print([hashlib.sha256(np.asarray(a)).hexdigest() for a in both(ours)])
"""


def test_results_do_not_depend_on_the_number_of_threads():
    assert run_python(DRAWN + HASHES, "1") == run_python(DRAWN + HASHES, "8")


OTHER_PROCESSOR = """
flags = [f for f in build.FLAGS if not f.startswith("-march")] + sys.argv[3:]
library = ctypes.CDLL(str(build.build(pathlib.Path(sys.argv[2]), tuple(flags))))
build.register(library)
def theirs(weights):
    x = pixels.astype("f") / 255 - mean
    for (kernel, bias), stride in zip(weights, (2, 1, 1)):
        x = jax.nn.relu(convolution.convolve(x, kernel, stride) + bias)
    return x
for mine, other in zip(both(ours), both(theirs)):
    np.testing.assert_allclose(mine, other, atol=1e-4 * np.abs(other).max())
print("equal")
"""


@pytest.mark.parametrize("kind", ["x86-64-v3", "x86-64-v4"])
def test_vectors_of_either_length_compute_the_same(kind):
    flags = pathlib.Path("/proc/cpuinfo").read_text()
    if {"x86-64-v3": " avx2 ", "x86-64-v4": " avx512vl "}[kind] not in flags:
        pytest.skip(f"this processor is no {kind}")
    text = DRAWN + OTHER_PROCESSOR
    folder = str(cache.compilation_folder())  # compiled once, also for later tests
    assert run_python(text, "8", folder, f"-march={kind}") == "equal\n"
