#!/usr/bin/env bash
# Sets up jaxil on this machine, then runs its checks and tests.
#
#   bash launch/test.sh
#       ruff, ruff format, pyright, then all tests
#   bash launch/test.sh tests/maths -k shift
#       pytest with these arguments, seen from the project's root
#
# Where it may, it also installs Slurm and Chromium, which a few tests start.

set -euo pipefail

# shellcheck source-path=SCRIPTDIR source=setup.sh
source "$(dirname "${BASH_SOURCE[0]}")/setup.sh"

# Programs that some tests start; those tests are skipped, and say so, without them.
install_test_packages() {
  local packages=() PATH=$PATH:/usr/sbin
  command -v slurmctld >/dev/null || packages+=(slurm-wlm)
  command -v chromium chromium-browser google-chrome >/dev/null ||
    packages+=(chromium)
  if ((${#packages[@]} == 0)); then
    return
  fi
  say "Installing ${packages[*]} with apt-get, for a few tests (about a minute)."
  (apt_install "${packages[@]}") 2>/dev/null ||
    say "That failed, so these tests are skipped; root can \`apt-get install" \
      "${packages[*]}\`."
}

set_up dev
install_test_packages
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
