"""Comparing results: which files can be, which rows are, and which settings differ."""

import json

import pytest

from jaxil.errors import UsageError
from jaxil.timing import summary

_OLD = {
    "update_ms": 10.0,
    "sample_ms": None,
    "render_ms": 0.0,
    "device": "cpu: cpu",
    "config": {"batch_size": 8, "encoder": {"strides": (4, 1)}},
}


def test_only_numbers_that_both_have_are_compared():
    new = {**_OLD, "update_ms": 15.0, "render_ms": 3.0, "sample_ms": 1.0, "act_ms": 2.0}
    rows = [line.split() for line in summary.comparison_table(_OLD, new).splitlines()]
    # In the order of the results' own table; a ratio to nothing is left out.
    assert rows[1:] == [
        ["render_ms", "0.00", "3.00"],
        ["update_ms", "10.00", "15.00", "1.50"],
    ]


def test_the_same_settings_differ_in_nothing():
    # Through a file, tuples become lists: no difference.
    assert summary.differences(json.loads(json.dumps(_OLD)), _OLD) == []


def test_other_devices_and_fields_are_named():
    config = {"batch_size": 16, "encoder": {"strides": (2, 1)}, "seed": 1}
    new = {**_OLD, "device": "gpu: H100", "config": config}
    assert summary.differences(_OLD, new) == [
        "device: 'cpu: cpu' then, 'gpu: H100' now",
        "config.batch_size: 8 then, 16 now",
        "config.encoder.strides: [4, 1] then, [2, 1] now",
        "config.seed: absent then, 1 now",
    ]


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        ("{", "Expecting property name"),
        ("[]", "without --sweep"),
        ("3", "not subscriptable"),
        ('{"update_ms": 3, "device": "cpu"}', "'config'"),
        ('{"update_ms": "fast", "device": "cpu", "config": {}}', "other types"),
        (b"\xff\xfe\x00", "decode"),
        ("[" * 200_000, "recursion"),
        (None, "No such file or directory"),
    ],
)
def test_files_without_results_are_refused(content, expected, tmp_path):
    path = tmp_path / "old.json"
    if content is not None:
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(UsageError) as caught:
        summary.read(str(path))
    assert str(path) in str(caught.value)
    assert expected in str(caught.value)
    assert "--json=FILE" in str(caught.value)


def test_results_come_back_from_a_file(tmp_path):
    path = tmp_path / "old.json"
    path.write_text(json.dumps(_OLD))
    assert summary.read(str(path))["update_ms"] == 10.0
