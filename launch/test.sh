#!/usr/bin/env bash
# Sets up jaxil on this machine, then runs its checks and tests.
#
#   bash launch/test.sh
#       ruff, ruff format, pyright, then all tests
#   bash launch/test.sh tests/maths -k shift
#       pytest with these arguments, from the project's root
#
# Where it may, it also installs Slurm and Chromium, which a few tests start.

set -euo pipefail

# shellcheck source-path=SCRIPTDIR source=setup.sh
source "$(dirname "${BASH_SOURCE[0]}")/setup.sh"

status=0
check() { # COMMAND...
  say "$ $*"
  "$@" || { status=1 && say "FAILED: $*"; }
}

set_up dev
packages=()
PATH=$PATH:/usr/sbin command -v slurmctld >/dev/null || packages+=(slurm-wlm)
command -v chromium chromium-browser google-chrome >/dev/null || packages+=(chromium)
((${#packages[@]} == 0)) || (apt_install "${packages[@]}") 2>/dev/null ||
  say "Tests that need these are skipped: \`apt-get install ${packages[*]}\`."
export PATH=$venv/bin:$PATH
if (($# == 0)); then # .pre-commit-config.yaml has the same three
  check ruff check .
  check ruff format --check .
  check pyright
  set -- -n 3 --dist worksteal # on two cores: some tests mostly wait
fi
check python -m pytest "$@"
exit "$status"
