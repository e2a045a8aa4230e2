#!/bin/sh
# Usage: scripts/install_torch.sh PYTHON
#
# Installs the torch of constraints.txt for the interpreter PYTHON. On Linux the default wheel of PyPI brings gigabytes
# of CUDA libraries; a machine without an NVIDIA GPU gets PyTorch's CPU build instead, where it can be reached.
set -eu
python=$1
torch=$(sed -n 's/^\(torch==[^ ;#]*\).*/\1/p' "$(dirname "$0")/../constraints.txt")
cpu_index=https://download.pytorch.org/whl/cpu

# pip 23.2 is the first that reads a wheel's dependencies without downloading the wheel; a newer pip is left as it is.
"$python" -m pip install --quiet "pip>=23.2"

wants_cuda() {
    "$python" -m pip install --quiet --dry-run --report - "$torch" | grep -qE '"name": "(nvidia|cuda)-'
}

if ! nvidia-smi >/dev/null 2>&1 && wants_cuda; then
    echo "No NVIDIA GPU here, and the default $torch would bring CUDA libraries: trying the CPU build of $cpu_index"
    if "$python" -m pip install --retries 1 --timeout 30 --extra-index-url "$cpu_index" "$torch+cpu"; then
        exit 0
    fi
    echo "The CPU build could not be installed from $cpu_index: going on with the default wheel, a large download."
fi
"$python" -m pip install "$torch"
