#!/usr/bin/env bash
# Sets up jaxil on this machine, then runs its checks and tests.
#
#   bash launch/test.sh
#       ruff, ruff format, pyright, then all tests
#   bash launch/test.sh tests/maths -k shift
#       pytest with these arguments, seen from the project's root

set -euo pipefail

# shellcheck source-path=SCRIPTDIR source=setup.sh
source "$(dirname "${BASH_SOURCE[0]}")/setup.sh"

set_up dev
export PATH=$venv/bin:$PATH

failed=()
check() { # COMMAND...
  say "$ $*"
  "$@" || failed+=("$*")
}

if (($# == 0)); then
  # .pre-commit-config.yaml has the same three.
  check ruff check .
  check ruff format --check .
  check pyright
  set -- -n 2 --dist worksteal
  for command in "${failed[@]}"; do
    say "FAILED: $command (the tests run all the same)"
  done
fi

status=0
python -m pytest "$@" || status=$?
if ((${#failed[@]} && status == 0)); then
  status=1
fi
exit "$status"
