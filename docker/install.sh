#!/bin/sh
# SPDX-License-Identifier: MIT
# Installs what serving needs, in the versions of constraints.txt, with the python3 in PATH. What docker/requirements.txt
# names must also have one of its hashes; torch's own would depend on TORCH_INDEX. The image is built with it, and a test
# runs it.
#
#   install.sh wheels FOLDER                   builds this checkout's wheels, of the client, the gateway, its page and the server
#   install.sh torch ENVIRONMENT               makes the environment and puts PyTorch into it
#   install.sh packages ENVIRONMENT FOLDER     puts FOLDER's wheels and what they need into it
#
# TORCH_INDEX: where PyTorch itself comes from, if not from PyPI, whose build is for CUDA
set -eu

root=$(dirname "$(dirname "$(realpath "$0")")")

make_environment() { # without a pip of its own
    python3 -m venv --without-pip "$1"
}

install_into() {
    environment=$1
    shift
    python3 -m pip --python "$environment/bin/python" install --disable-pip-version-check --quiet --only-binary :all: \
        --constraint "$root/constraints.txt" "$@"
}

build_wheels() {
    builder=$(mktemp -d)
    make_environment "$builder"
    install_into "$builder" setuptools
    python3 -m pip --python "$builder/bin/python" wheel --disable-pip-version-check --quiet --no-deps \
        --no-build-isolation --wheel-dir "$1" "$root/client" "$root/apps/gateway" "$root/apps/page" "$root"
    rm -rf "$builder"
}

install_torch() {
    make_environment "$1"
    if [ -n "${TORCH_INDEX:-}" ]; then
        install_into "$1" --no-deps --index-url "$TORCH_INDEX" torch
    fi
    install_into "$1" torch
}

install_packages() { # by file: a wheel of this name on an index would not be ours
    # Anew what came with torch: of what is installed already pip compares no hash.
    install_into "$1" --no-deps --require-hashes --force-reinstall --requirement "$root/docker/requirements.txt"
    install_into "$1" --no-deps "$2"/rfm_client-*.whl "$2"/rfm_gateway-*.whl "$2"/rfm_page-*.whl "$2"/rfm_triton-*.whl
    python3 -m pip --python "$1/bin/python" check --disable-pip-version-check
}

case "${1:-} $#" in
    "wheels 2") build_wheels "$2" ;;
    "torch 2") install_torch "$2" ;;
    "packages 3") install_packages "$2" "$3" ;;
    *)
        echo "install.sh: expected wheels FOLDER, torch ENVIRONMENT or packages ENVIRONMENT FOLDER, got: $*" >&2
        exit 2
        ;;
esac
