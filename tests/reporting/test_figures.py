"""The runs behind the paper's figures, and their names."""

import pytest

from jaxil import config as jaxil_config
from jaxil.reporting.figures import FIGURES, METHOD_NAMES, Variant, variant_of

EVERY = sorted(
    {variant.slug: variant for f in FIGURES.values() for variant in f.variants}.items()
)


def test_every_figure_with_curves_or_bars_is_there():
    assert list(FIGURES) == list(range(2, 13))  # the first one is a drawing
    assert {v.method for f in FIGURES.values() for v in f.variants} == {
        "pdac",
        "psil",
        "dac",
        "sil",
        "bc",
    }


def test_every_method_has_a_name():
    assert set(METHOD_NAMES) == set(jaxil_config.METHODS)


@pytest.mark.parametrize("variant", [v for _, v in EVERY], ids=[s for s, _ in EVERY])
def test_a_config_is_the_variant_that_it_was_made_as(variant):
    config = jaxil_config.default_config(variant.method, "walker_walk")
    for field, value in variant.overrides.items():
        config.update_from_flattened_dict({field: value})
    assert jaxil_config.problems(config, ("walker_walk",)) == []
    assert variant_of(config.to_dict()) == variant


def test_names_by_hand():
    changes = {"demonstrations.num_episodes": 1, "shift_padding": 0}
    variant = Variant("bc", changes)
    assert variant.label == "BC, 1 demonstration, no augmentation"
    assert variant.slug == "bc_1_demonstration_no_augmentation"
    # What a method does not read tells none of its runs apart.
    config = jaxil_config.default_config("drqv2", "walker_walk")
    config.demonstrations.num_episodes = 50
    assert variant_of(config.to_dict()) == Variant("drqv2", {})


def test_configs_of_before_a_field_existed_have_its_default():
    config = jaxil_config.default_config("psil", "walker_walk").to_dict()
    del config["sinkhorn"]["cost"], config["sinkhorn"]["alignment"]
    assert variant_of(config) == Variant("psil", {})
