"""The runs behind the paper's figures, and their names."""

import pytest

from jaxil import config as jaxil_config
from jaxil import methods, outside
from jaxil.reporting import paper
from jaxil.reporting.figures import FIGURES, Variant, variant_of
from tests.reporting.run_folders import groups_below, write_run

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


def test_every_declared_variation_has_a_name():
    for name, method in methods.known().items():
        assert Variant(name).label == method.label
        for field, plain, words in method.variations:
            label = Variant(name, {field: plain}).label
            assert label == f"{method.label}, {words.format(plain)}"


def test_methods_from_outside_and_missing_ones_have_names(tmp_path, monkeypatch):
    (tmp_path / "outside.py").write_text(
        "from jaxil import methods\n"
        "METHOD = methods.Method(\n"
        "    name='mine', label='Mine', about='',\n"
        "    sections={'own': {'size': methods.Field(1, '')}},\n"
        "    variations=(methods.Variation('own.size', 1, 'size {}'),))\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    outside.trust("outside:METHOD")
    variant = variant_of({"method": "outside:METHOD", "own": {"size": 2}})
    assert (variant.label, variant.slug) == ("Mine, size 2", "outside_METHOD_size_2")
    gone = variant_of({"method": "no/such.module:METHOD", "shift_padding": 0})
    assert gone.label == "no/such.module:METHOD, no augmentation"
    assert gone.slug == "no_such.module_METHOD_no_augmentation"
    assert len(Variant("é" * 500).slug.encode()) <= 255


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


def test_configs_older_than_a_field_have_its_default():
    config = jaxil_config.default_config("psil", "walker_walk").to_dict()
    del config["sinkhorn"]["cost"], config["sinkhorn"]["alignment"]
    assert variant_of(config) == Variant("psil", {})


def test_an_ablation_is_plotted_once_a_changed_run_has_an_evaluation(tmp_path):
    write_run(tmp_path / "pdac", "pdac", "walker_walk", 0, {1000: 1})
    write_run(tmp_path / "psil", "psil", "walker_walk", 0, {1000: 1})
    changes = {"shift_padding": 0}
    folder = write_run(
        tmp_path / "changed", "pdac", "walker_walk", 0, None, changes=changes
    )

    def plotted():
        shown = paper.paper_figures(groups_below(tmp_path), None)
        return [each.figure.number for each in shown if each.sheet is not None]

    assert plotted() == [2, 3, 4]
    (folder / "eval.csv").write_bytes((tmp_path / "pdac" / "eval.csv").read_bytes())
    assert plotted() == [2, 3, 4, 6, 10]
