#!/bin/sh
# onnxruntime's C++ headers in FOLDER, for a Debian older than 13, which has no libonnxruntime-dev: out of Debian 13's package,
# which is fetched from the mirror that this system uses and unpacked, not installed.
#   ./headers.sh FOLDER      then: cmake -DONNXRUNTIME_INCLUDE=FOLDER/usr/include/onnxruntime …
set -eu
mkdir -p "${1:?give a folder}/apt/lists/partial" "$1/apt/cache/archives/partial"
cd "$1"
test ! -f usr/include/onnxruntime/onnxruntime_cxx_api.h || exit 0
mirror=$(apt-get indextargets --format '$(REPO_URI)' 'Created-By: Packages' | grep -m 1 '/debian/*$') || {
    echo "no Debian mirror is among this system's package sources; take onnxruntime's headers from its release" >&2
    exit 1
}
echo "deb [signed-by=/usr/share/keyrings/debian-archive-keyring.gpg] $mirror trixie main" > apt/sources.list
options="-q -o Dir::Etc::SourceList=$PWD/apt/sources.list -o Dir::Etc::SourceParts=/dev/null"
options="$options -o Dir::State::Lists=$PWD/apt/lists -o Dir::Cache=$PWD/apt/cache -o APT::Sandbox::User=root"
apt-get $options update
apt-get $options download libonnxruntime-dev
dpkg-deb --extract libonnxruntime-dev_*.deb .
rm -r apt libonnxruntime-dev_*.deb
test -f usr/include/onnxruntime/onnxruntime_cxx_api.h
