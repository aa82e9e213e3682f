#!/bin/sh
# onnxruntime's C++ headers in FOLDER, for systems without libonnxruntime-dev (Debian 12, Ubuntu 22.04 and 24.04): out of
# Debian 13's package, which is fetched and unpacked, not installed. Ubuntu needs the package debian-archive-keyring.
#   ./headers.sh FOLDER      then: cmake -DONNXRUNTIME_INCLUDE=FOLDER/usr/include/onnxruntime …
set -eu
mkdir -p "${1:?give a folder}/apt/lists/partial" "$1/apt/cache/archives/partial"
cd "$1"
test ! -f usr/include/onnxruntime/onnxruntime_cxx_api.h || exit 0
keyring=/usr/share/keyrings/debian-archive-keyring.gpg
echo "deb [signed-by=$keyring] http://deb.debian.org/debian trixie main" > apt/sources.list
options="-q -o Dir::Etc::SourceList=$PWD/apt/sources.list -o Dir::Etc::SourceParts=/dev/null"
options="$options -o Dir::State::Lists=$PWD/apt/lists -o Dir::Cache=$PWD/apt/cache -o APT::Sandbox::User=root"
apt-get $options update
apt-get $options download libonnxruntime-dev
dpkg-deb --extract libonnxruntime-dev_*.deb .
rm -r apt libonnxruntime-dev_*.deb
test -f usr/include/onnxruntime/onnxruntime_cxx_api.h
