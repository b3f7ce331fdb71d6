#!/usr/bin/env bash
# Install the system libraries that Open3D's wheel needs but slim machines lack.
# Does nothing when all are present; uses apt when it may, otherwise says in one line what to install.
set -eu
[ "$(uname -s)" = Linux ] || exit 0

# shared library -> Debian package
libraries="libusb-1.0.so.0:libusb-1.0-0 libGL.so.1:libgl1 libEGL.so.1:libegl1 libX11.so.6:libx11-6
           libudev.so.1:libudev1 libidn2.so.0:libidn2-0 libgomp.so.1:libgomp1"

present() {
    PATH="$PATH:/sbin:/usr/sbin"
    ldconfig -p 2>/dev/null | grep -qF "$1"
}

missing=""
for entry in $libraries; do
    present "${entry%%:*}" || missing="$missing ${entry##*:}"
done
python="${PYTHON:-python3}"
if ! "$python" -c "import ensurepip, venv" 2>/dev/null; then
    missing="$missing python3-venv"
fi
[ -z "$missing" ] && exit 0

say="scan2albedo needs these system packages:$missing. Install them, on Debian or Ubuntu with: sudo apt-get install -y$missing"
command -v apt-get >/dev/null 2>&1 || { echo "$say" >&2; exit 1; }
if [ "$(id -u)" = 0 ]; then run=""
elif sudo -n true 2>/dev/null; then run="sudo -n"
else echo "$say" >&2; exit 1
fi
echo "installing system packages:$missing"
export DEBIAN_FRONTEND=noninteractive
# A stale package list is the usual reason for a failed install, so refresh it first.
{ $run apt-get update -qq && $run apt-get install -y -qq --no-install-recommends $missing; } >/dev/null \
    || { echo "$say" >&2; exit 1; }
