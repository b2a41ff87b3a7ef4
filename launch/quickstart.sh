#!/usr/bin/env bash
# Sets up jaxil on this machine, then trains an agent.
#
#   bash launch/quickstart.sh
#       learns from the pixels of ten episodes to catch a ball in a cup, with small
#       networks that learn on two CPU cores, into runs/quickstart
#   bash launch/quickstart.sh --config.seed=1 --workdir=runs/seed1
#       the same with other settings
#   bash launch/quickstart.sh --config=psil:walker_walk --workdir=runs/x
#       runs `jaxil train` with these flags
#
# Rerun the same command to resume. Relative paths start at the project's root. The
# set-up takes minutes, once: see launch/setup.sh.

set -euo pipefail

# shellcheck source-path=SCRIPTDIR source=setup.sh
source "$(dirname "${BASH_SOURCE[0]}")/setup.sh"

# As in jaxil/machine/devices.py: a device hidden from CUDA or jax does not count.
has_nvidia_device() {
  case ${JAX_PLATFORMS:-} in cpu*) return 1 ;; esac
  case ${CUDA_VISIBLE_DEVICES-all} in "" | -1) return 1 ;; esac
  compgen -G "/dev/nvidia[0-9]*" >/dev/null || nvidia-smi --list-gpus >/dev/null 2>&1
}

extras=
if has_nvidia_device; then extras=gpu; fi
case " $* " in
  *" --help "* | *" -h "*)
    sed -n '2,/^$/s/^# \{0,1\}//p' "${BASH_SOURCE[0]}"
    cd "$root"
    is_ready "$extras" || exit 0 # a question should not start an installation
    ;;
esac
set_up "$extras"

has_flag() { # name, words
  local name=$1 word
  shift
  for word; do
    case $word in "$name" | "$name="*) return 0 ;; esac
  done
  return 1
}

if ! has_flag --config "$@" && ! has_flag --help "$@" && ! has_flag -h "$@"; then
  if ! has_flag --workdir "$@"; then
    set -- --workdir=runs/quickstart "$@"
    say "Folder of the run: $root/runs/quickstart (learning_curve.png, videos/, eval.csv)." \
      "Ctrl-C saves and stops; rerun the same command to resume."
  fi
  set -- --config=tiny:psil,ball_in_cup_catch "$@"
fi
exec "$venv/bin/python" -m jaxil.launch "$@"
