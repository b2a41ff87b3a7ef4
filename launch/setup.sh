# shellcheck shell=bash
# Set-up on Linux, for quickstart.sh and test.sh, which source this file.
#
# set_up installs the project into .venv at its root, in editable mode, with the
# versions of constraints.txt; as root also OpenGL and GCC. A ready .venv is reused, one
# that was cut off is rebuilt, and two set-ups at once take turns. PYTHON=PATH chooses
# the interpreter of a new .venv.

root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd -P)
venv=$root/.venv
pythons=(python3.11 python3.12 python3) # labmaze, of dm-control, has no later wheels
gl_packages=(libegl1 libgl1-mesa-dri libosmesa6)
ready_file=$venv/jaxil-ready # lines "DIGEST EXTRAS"; absent while .venv is changed
system_file=$venv/jaxil-system # there once GL was found or installed
log_file=$root/.jaxil-setup.log

say() { printf '%s\n' "$*" >&2; }

fail() { # STATUS SENTENCE...
  say "${@:2}"
  exit "$1"
}

# Makes .venv ready for "dev", "gpu" or "" and steps into the project's root.
set_up() { # EXTRAS
  local lock python=$venv/bin/python
  cd "$root" || exit 1
  if is_ready "$1" && [[ -e $system_file ]]; then return; fi
  touch "$log_file" 2>/dev/null ||
    fail 2 "$root cannot be written: change its permissions or copy the project."
  exec {lock}<"$root"
  flock --nonblock "$lock" || { say "Waiting for another set-up." && flock "$lock"; }
  is_ready "$1" || install_project "$1"
  [[ -e $system_file ]] || install_system_packages
  exec {lock}<&-
}

install_project() { # EXTRAS
  local ready stamp
  ready=$(cat "$ready_file" 2>/dev/null) || ready=
  if [[ -z $ready ]] || ! digest >/dev/null; then
    [[ ! -e $venv ]] || say "$venv is unfinished or damaged: rebuilding it."
    find_python || fail 2 "No Python 3.11 or 3.12 with venv was found: install one" \
      "(Debian 12: apt-get install python3-venv), or name one with PYTHON=PATH."
    run_logged "$python" -m venv --clear "$venv"
    python=$venv/bin/python
  fi
  rm -f "$ready_file"
  say "Installing jaxil and its dependencies into $venv (2 to 5 minutes, once)."
  mkdir -p "$venv/tmp" # packages for GPUs are too large for some machines' /tmp
  run_logged env PIP_USER=0 TMPDIR="$venv/tmp" "$python" -m pip install --no-input \
    --progress-bar off --disable-pip-version-check -c launch/constraints.txt \
    -e ".${1:+[$1]}"
  rm -rf "$venv/tmp"
  stamp=$(digest)
  { grep "^$stamp " <<<"$ready" || true; } >"$ready_file.new" # other extras
  echo "$stamp $1" >>"$ready_file.new"
  mv "$ready_file.new" "$ready_file"
}

is_ready() { # EXTRAS; each includes the project's own dependencies
  local stamp
  stamp=$(digest) && grep -qs "^$stamp ${1:+$1\$}" "$ready_file"
}

# Prints a digest of what .venv's packages depend on: folder, Python and two files.
digest() {
  local version
  version=$("$venv/bin/python" -c 'import sys; print(sys.version)' 2>&1) || return 1
  printf '%s\n' "$root" "$version" | cat - setup.cfg launch/constraints.txt | sha256sum |
    cut -d ' ' -f 1
}

# Sets python. Installs Debian's venv package where only that is missing.
find_python() {
  local candidate version print_version='import sys; print("%d.%d" % sys.version_info[:2])'
  for candidate in "${PYTHON:-${pythons[@]}}"; do
    version=$("$candidate" 2>/dev/null -c "$print_version") || continue
    [[ $version == 3.1[12] ]] || continue
    "$candidate" -c 'import ensurepip, venv' 2>/dev/null ||
      (apt_install "python$version-venv") || continue
    python=$candidate
    return
  done
  return 1
}

# Without GCC all works, but more slowly: the encoder in C is not used.
install_system_packages() {
  [[ -n ${CC:-}$(type -P gcc) || $EUID != 0 ]] || (apt_install gcc libc6-dev) ||
    say "Continuing without GCC."
  # A user who chose another backend knows what it needs.
  [[ " unset egl osmesa " != *" ${MUJOCO_GL-unset} "* ]] || "$python" -c "
from jaxil.machine.startup import gl_works
raise SystemExit(not (gl_works('egl') or gl_works('osmesa')))" ||
    apt_install "${gl_packages[@]}"
  touch "$system_file"
}

apt_install() { # PACKAGES...
  local sudo=() package packages=()
  [[ $EUID == 0 ]] || sudo=(sudo -n)
  { command -v apt-get && "${sudo[@]}" true; } >/dev/null 2>&1 ||
    fail 2 "System packages are missing: run \`apt-get install $*\` as root, then this" \
      "command again."
  say "Installing $* with apt-get (about a minute)."
  # Repairs what an earlier cut-off left; a source that is out of reach may not matter.
  "${sudo[@]}" bash -c 'dpkg --configure -a; apt-get update' >"$log_file" 2>&1 || true
  for package in "$@"; do # newer distributions lack libosmesa6, Ubuntu lacks chromium
    if apt-cache show "$package" >/dev/null 2>&1; then packages+=("$package"); fi
  done
  run_logged "${sudo[@]}" env DEBIAN_FRONTEND=noninteractive apt-get -q -y \
    -o DPkg::Lock::Timeout=300 install --no-install-recommends "${packages[@]}"
}

run_logged() { # COMMAND...
  "$@" >"$log_file" 2>&1 && return
  tail -n 40 "$log_file" >&2
  fail 1 "Set-up failed, see above and $log_file; rerun the same command to retry."
}
