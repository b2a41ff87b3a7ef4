"""Tries faults of all kinds, and counts what held.

    python -m tests.faults                # a sample, of minutes
    python -m tests.faults --full         # about an hour of a core
    python -m tests.faults --kinds=folders,files --share=0.1

Each kind is deterministic from --seed, except for the moments at which processes are
killed. What did not hold is printed; the exit status is then 1.
"""

import argparse
import pathlib
import sys
import tempfile
import time

from tests.faults import kinds

_SAMPLE = 0.02  # of the full numbers


def main() -> int:
    """Runs the campaign."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--full", action="store_true", help="the full numbers")
    parser.add_argument("--share", type=float, default=_SAMPLE, help="of them")
    parser.add_argument("--kinds", default=",".join(kinds.KINDS), help="which")
    parser.add_argument("--seed", type=int, default=0)
    flags = parser.parse_args()
    share = 1.0 if flags.full else flags.share
    print("| Fault | Tried | Held | Seconds |\n|---|---|---|---|", flush=True)
    all_held = True
    for name in flags.kinds.split(","):
        kind = kinds.KINDS[name]
        count, begin = max(1, round(share * kind.full_count)), time.monotonic()
        with tempfile.TemporaryDirectory() as folder:
            outcomes = kind.run(pathlib.Path(folder), count, flags.seed)
            failures = [outcome for outcome in outcomes if outcome]
        seconds = time.monotonic() - begin
        held = count - len(failures)
        print(f"| {kind.about} | {count} | {held} | {seconds:.0f} |", flush=True)
        for failure in failures[:20]:
            print(f"  {name}: {failure}", file=sys.stderr)
        all_held &= not failures
    return int(not all_held)


if __name__ == "__main__":
    sys.exit(main())
