"""Nested settings as flat dictionaries."""

import json
from collections.abc import Mapping
from typing import Any


def flat(tree: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Returns the leaves of nested settings by dotted name ("sinkhorn.cost")."""
    leaves: dict[str, Any] = {}
    for name, value in tree.items():
        if isinstance(value, Mapping):
            leaves |= flat(value, f"{prefix}{name}.")
        else:
            leaves[f"{prefix}{name}"] = value
    return leaves


def as_stored(tree: Mapping[str, Any]) -> dict[str, Any]:
    """Returns settings after a round trip through JSON: tuples become lists."""
    return json.loads(json.dumps(tree))
