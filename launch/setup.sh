# shellcheck shell=bash
# Set-up on Linux, shared by quickstart.sh and test.sh, which source this file.
#
# set_up makes .venv at the project's root ready: GL libraries from the system's
# packages, then the project in editable mode at the versions of constraints.txt. What
# is ready is reused, what was cut off is made again, and two at once take turns.
# PYTHON=/path/to/python chooses the interpreter of a new .venv.

root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd -P)
venv=$root/.venv
# Later Pythons have no wheel of labmaze, which dm-control needs.
pythons=(python3.11 python3.12 python3)
python_versions=" 3.11 3.12 "
# The same names as in jaxil/platform.py, which must not need this file.
gl_packages=(libegl1 libgl1-mesa-dri libosmesa6)
ready_file=$venv/jaxil-ready           # lines "DIGEST EXTRAS": what .venv holds whole
unfinished_file=$venv/jaxil-unfinished # there only while .venv is being changed
log_file=$venv/jaxil-setup.log
# Gigabytes with a GPU, too many for some machines' /tmp, and left behind by a kill.
scratch=$venv/jaxil-scratch
python=
child=

say() { printf '%s\n' "$*" >&2; }

fail() { # STATUS SENTENCE...
  say "${@:2}"
  exit "$1"
}

# Makes .venv ready for "dev", "gpu" or "" and steps into the project's root.
set_up() { # EXTRAS
  local lock
  cd "$root" || exit 1
  if is_ready "$1" && gl_works "$venv/bin/python"; then
    return
  fi
  if ! { mkdir -p "$venv" && touch "$venv/jaxil-lock"; } 2>/dev/null; then
    fail 2 "$venv can't be written: make $root writable, or copy the project."
  fi
  exec {lock}>>"$venv/jaxil-lock"
  if ! flock --nonblock "$lock"; then
    say "Waiting for another set-up of $venv."
    flock "$lock"
  fi
  trap 'stop 130' INT
  trap 'stop 143' TERM HUP
  if [[ -e $unfinished_file ]]; then
    say "An earlier set-up was cut off: beginning again."
    clear_venv
  fi
  install_system_packages
  install_compiler
  is_ready "$1" || install_project "$1"
  trap - INT TERM HUP
  exec {lock}>&-
}

stop() { # STATUS
  [[ -z $child ]] || kill "$child" 2>/dev/null || true
  wait
  rm -rf "$scratch" || true
  fail "$1" "Set-up cut off; the same command begins it again."
}

is_ready() { # EXTRAS
  local stamp
  [[ -f $ready_file && ! -e $unfinished_file ]] || return 1
  stamp=$(digest) || return 1
  # Each extra brings all of the project's own dependencies too.
  grep -q "^$stamp ${1:+$1\$}" "$ready_file"
}

# Prints what decides on the packages of .venv: its folder (editable mode), its Python,
# and the two files.
digest() {
  local version
  version=$("$venv/bin/python" -c 'import sys; print(sys.version)' 2>&1) || return 1
  printf '%s\n' "$root" "$version" | cat - setup.cfg launch/constraints.txt |
    sha256sum | cut -d ' ' -f 1
}

# The lock stays, since others wait for it, and the mark of being unfinished.
clear_venv() {
  find "$venv/" -mindepth 1 -maxdepth 1 ! -name jaxil-lock \
    ! -name jaxil-unfinished -exec rm -rf {} +
}

install_system_packages() {
  local packages=() version=
  find_python
  if [[ -z $python ]]; then
    [[ -n $version ]] || fail 2 "No Python 3.11 or 3.12 was found: install one" \
      "(Debian 12: apt-get install python3-venv), or name one with PYTHON=PATH."
    packages+=("python$version-venv")
  fi
  gl_works "${python:-python$version}" || packages+=("${gl_packages[@]}")
  if ((${#packages[@]} == 0)); then
    return
  fi
  if [[ -n $python ]] && dpkg-query --show "${packages[@]}" >/dev/null 2>&1; then
    say "GL does not work here, although ${packages[*]} are installed;" \
      "\`.venv/bin/python -m jaxil.doctor\` says more."
    return
  fi
  apt_install "${packages[@]}"
  find_python
  [[ -n $python ]] || fail 2 "${packages[0]} brought no usable Python:" \
    "name one that has venv and ensurepip with PYTHON=PATH."
}

# For convolutions (`jaxil/native.py`). Without one all works, more slowly: it is not
# worth a password, nor a failure.
install_compiler() {
  [[ -z ${CC:-}$(type -P gcc) && $EUID == 0 ]] || return 0
  (apt_install gcc libc6-dev) || say "Going on without GCC."
}

# Sets python; where it finds none, sets the caller's version to that of a Python which
# lacks nothing but Debian's package of venv.
find_python() {
  local candidate found
  python=
  version=
  for candidate in "$venv/bin/python" "${PYTHON:-${pythons[@]}}"; do
    found=$("$candidate" -c 'import sys; print("%d.%d" % sys.version_info[:2])' \
      2>/dev/null) || continue
    [[ $python_versions == *" $found "* ]] || continue
    if "$candidate" -c 'import ensurepip, venv' 2>/dev/null; then
      python=$candidate
      return
    fi
    version=$found
  done
}

# Whether one of the backends that jaxil.platform would try makes images here. A
# library alone proves little: EGL without a driver finds no device.
gl_works() { # PYTHON
  # A user who chose another backend knows what it needs.
  [[ " unset egl osmesa " == *" ${MUJOCO_GL-unset} "* ]] || return 0
  timeout 20 "$1" - "${MUJOCO_GL-}" <<'END' 2>/dev/null
import sys
from ctypes import CDLL, CFUNCTYPE, POINTER, byref, c_char_p, c_int, c_uint, c_void_p
from ctypes.util import find_library

chosen = sys.argv[1]
if chosen != "egl" and find_library("OSMesa"):
    sys.exit(0)
if chosen == "osmesa":
    sys.exit(1)
egl = CDLL("libEGL.so.1")
egl.eglGetProcAddress.argtypes, egl.eglGetProcAddress.restype = [c_char_p], c_void_p
egl.eglInitialize.argtypes = [c_void_p, POINTER(c_int), POINTER(c_int)]
query = CFUNCTYPE(c_uint, c_int, POINTER(c_void_p), POINTER(c_int))(
    egl.eglGetProcAddress(b"eglQueryDevicesEXT")
)
display = CFUNCTYPE(c_void_p, c_uint, c_void_p, POINTER(c_int))(
    egl.eglGetProcAddress(b"eglGetPlatformDisplayEXT")
)
devices, number = (c_void_p * 16)(), c_int()
query(16, devices, byref(number))
EGL_PLATFORM_DEVICE = 0x313F
found = (display(EGL_PLATFORM_DEVICE, each, None) for each in devices[: number.value])
sys.exit(not any(each and egl.eglInitialize(each, None, None) for each in found))
END
}

apt_install() { # PACKAGES...
  local sudo=() apt package packages=()
  [[ $EUID == 0 ]] || sudo=(sudo -n)
  if ! { command -v apt-get && "${sudo[@]}" true; } >/dev/null 2>&1; then
    fail 2 "System packages are missing, and only root may install them: run" \
      "\`sudo apt-get install $*\`, then this command again."
  fi
  apt=("${sudo[@]}" env DEBIAN_FRONTEND=noninteractive apt-get -q -y
    -o DPkg::Lock::Timeout=300)
  say "Installing $* with apt-get (about a minute)."
  {
    # Mends what an earlier cut-off left. A source out of reach may not matter.
    "${sudo[@]}" dpkg --configure -a || true
    "${apt[@]}" update || true
    for package in "$@"; do
      # Newer distributions have dropped libosmesa6; EGL does without it. Ubuntu has
      # another way to bring chromium.
      if [[ $package != @(libosmesa6|chromium) ]] || apt-cache show "$package"; then
        packages+=("$package")
      fi
    done
    "${apt[@]}" install --no-install-recommends "${packages[@]}"
  } >"$log_file" 2>&1 || {
    show_log
    fail 2 "apt-get failed, see above: run \`apt-get install $*\` as root, then this" \
      "command again."
  }
}

install_project() { # EXTRAS
  local project=. about="2 minutes, 2 GB of disk" started=$SECONDS stamp
  [[ -z $1 ]] || project=".[$1]"
  [[ $1 != gpu ]] || about="5 minutes, 8 GB of disk"
  say "Installing jaxil and its dependencies into $venv (once: about $about)."
  touch "$unfinished_file"
  if [[ $python != "$venv/bin/python" ]]; then
    clear_venv
    run_logged "$python" -m venv "$venv"
  elif ! "$python" -m pip --version >/dev/null 2>&1; then
    run_logged "$python" -m ensurepip
  fi
  python=$venv/bin/python
  mkdir -p "$scratch"
  run_logged env PIP_USER=0 TMPDIR="$scratch" "$python" -m pip install \
    --no-input --progress-bar off --disable-pip-version-check \
    -c launch/constraints.txt -e "$project"
  rm -rf "$scratch"
  stamp=$(digest)
  {
    grep -s "^$stamp " "$ready_file" || true # other extras, at the same versions
    echo "$stamp $1"
  } >"$ready_file.new"
  mv "$ready_file.new" "$ready_file"
  # Last: as long as it is there, nothing is ready.
  rm "$unfinished_file"
  say "Set up in $((SECONDS - started)) s."
}

# Runs a command that a signal ends at once, and with it the set-up.
run_logged() { # COMMAND...
  "$@" >"$log_file" 2>&1 &
  child=$!
  wait "$child" || {
    # It ended by itself and undid what it had begun: no need to begin from nothing.
    rm -rf "$unfinished_file" "$scratch"
    show_log
    fail 1 "Set-up failed, see above; all of it is in $log_file."
  }
  child=
}

show_log() { tail -n 40 "$log_file" >&2; }
