"""A sample of the campaign; `python -m tests.faults --full` is all of it.

Runs that are killed, stopped or out of disk compile for half a minute first. Of these
the suite has its own tests, and the campaign's are run with JAXIL_FAULTS=0.02, the
share of the full numbers.
"""

import os

import pytest

from tests.faults import kinds

_SHARE = float(os.environ.get("JAXIL_FAULTS", "0"))
_SAMPLES = {"folders": 60, "files": 30}


@pytest.mark.parametrize("name", kinds.KINDS)
def test_a_sample_holds(name, tmp_path):
    kind = kinds.KINDS[name]
    count = max(_SAMPLES.get(name, 0), round(_SHARE * kind.full_count))
    if not count:
        pytest.skip("set JAXIL_FAULTS=0.02, for that share of the full number")
    outcomes = list(kind.run(tmp_path, count, 1))
    assert len(outcomes) == count
    assert [outcome for outcome in outcomes if outcome] == []
