#!/usr/bin/env bash
# SPDX-License-Identifier: GPL-3.0-or-later
# A real Blender from Debian, in a folder of its own, with a screen in memory. Needs root.
#
#   tools/debian_blender.sh setup SUITE FOLDER             sid has Blender 5.2, trixie has 4.3
#   tools/debian_blender.sh run FOLDER [-b PATH]... [--] COMMAND...
#
# `run` is a chroot whose mounts and processes end with it. Each -b PATH (and what it links to) is there at its own place.
set -euo pipefail

PACKAGES="blender python3-numpy python3-cattr python3-requests python3-zstandard
  libgl1-mesa-dri libegl1 libgl1 xvfb xauth xdotool imagemagick x11-utils procps"
# The mirror this machine's own apt uses, else debootstrap's default.
MIRROR="${GSKIN_DEBIAN_MIRROR:-$(grep -rhoE "https?://[^ ]+/debian/?( |$)" /etc/apt/sources.list /etc/apt/sources.list.d 2>/dev/null | head -1 | tr -d " " || true)}"

say() { echo "debian_blender: $*" >&2; }

lost() {
  tail -5 "$1.log" >&2
  say "apt-get failed; the whole log is $1.log."
  exit 1
}

setup() {
  local suite="$1" folder="$2" stamp="$2/.gskin-blender"
  local wanted="$suite $PACKAGES"
  if [ -f "$stamp" ] && [ "$(cat "$stamp")" = "$wanted" ]; then
    return 0
  fi
  [ "$(id -u)" = 0 ] || { say "making a Debian needs root: run as root, or name a Blender with BLENDER=/path/to/blender."; exit 2; }
  command -v debootstrap >/dev/null || { apt-get update -q && apt-get install -qy --no-install-recommends debootstrap; } >&2
  mkdir -p "$folder"
  if [ ! -f "$folder/.gskin-base" ]; then
    say "making Debian $suite in $folder"
    rm -rf --one-file-system "$folder" && mkdir -p "$folder"
    debootstrap --variant=minbase "$suite" "$folder" ${MIRROR:+"$MIRROR"} >"$folder.log" 2>&1 ||
      { tail -5 "$folder.log" >&2; say "debootstrap failed; the whole log is $folder.log."; exit 1; }
    touch "$folder/.gskin-base"
  fi
  say "installing Blender in $folder"
  local apt="apt-get -q" install
  install="DEBIAN_FRONTEND=noninteractive apt-get install -qy --no-install-recommends $(echo $PACKAGES) && apt-get clean"
  if ! run "$folder" -- $apt update >>"$folder.log" 2>&1; then
    # A mirror that stands still outlives the date on its lists. Signatures are checked all the same.
    say "the package lists are past their date; taking them as they are"
    apt="$apt -o Acquire::Check-Valid-Until=false"
    run "$folder" -- $apt update >>"$folder.log" 2>&1 || lost "$folder"
  fi
  run "$folder" -- sh -c "$install" >>"$folder.log" 2>&1 || lost "$folder"
  echo "$wanted" >"$stamp"
}

run() {
  local folder="$1" bind=()
  shift
  while [ "${1:-}" = -b ]; do
    bind+=("$2")
    shift 2
  done
  [ "${1:-}" = -- ] && shift
  # Mount and process namespaces of its own: nothing stays mounted and nothing stays running, however this ends.
  unshare --mount --pid --fork --kill-child bash -c '
    set -e
    folder="$1"; count="$2"; shift 2
    mount --make-rprivate /
    mount -t proc proc "$folder/proc"
    mkdir -p "$folder/dev/shm" && mount -t tmpfs tmpfs "$folder/dev/shm"
    cp -L /etc/resolv.conf "$folder/etc/resolv.conf" 2>/dev/null || true
    cp -L /etc/hosts "$folder/etc/hosts" 2>/dev/null || true
    while [ "$count" -gt 0 ]; do
      mkdir -p "$folder$1" && mount --rbind "$1" "$folder$1"
      count=$((count - 1)); shift
    done
    # Not exec: xvfb-run waits for a signal that the first process of a namespace never gets.
    chroot "$folder" /usr/bin/env HOME=/root PATH=/usr/sbin:/usr/bin:/sbin:/bin "$@" || exit $?
  ' bash "$folder" "${#bind[@]}" "${bind[@]}" "$@"
}

case "${1:-}" in
  setup) shift && setup "$@" ;;
  run) shift && run "$@" ;;
  *) sed -n '3,9p' "$0" >&2 && exit 2 ;;
esac
