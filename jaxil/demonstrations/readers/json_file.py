"""JSON files of strangers: small, and an object."""

import json
import pathlib
from typing import Any

from jaxil.demonstrations.readers.recording import FormatError


def read_object(path: pathlib.Path, *, max_bytes: int) -> dict[str, Any]:
    """Returns the keys and values of a JSON file.

    Raises:
      FormatError: it is too long, no JSON, or JSON of something else.
      OSError: it cannot be opened.
    """
    if path.exists() and not path.is_file():
        raise FormatError(f"has a {path.name} that is no file")
    with path.open("rb") as file:
        content = file.read(max_bytes + 1)
    if len(content) > max_bytes:
        raise FormatError(
            f"has a {path.name} of more than the {max_bytes} bytes that are accepted"
        )
    try:
        values = json.loads(content)
    except (ValueError, RecursionError) as error:
        raise FormatError(f"has a {path.name} that is not JSON ({error})") from error
    if not isinstance(values, dict):
        raise FormatError(f"has a {path.name} that is no JSON object")
    return values
