#!/usr/bin/env bash
# The tests of `make fast` with the lowest versions that pyproject.toml declares, in an environment of their own:
#
#     tools/lowest_versions.sh FOLDER [options of `uv pip install`]
#
# PYTHON chooses the interpreter. Versions of what other packages bring are the newest, as for a user. Torch's wheels
# for Linux bring CUDA (3 GB); a file with one that is at hand takes its place: --override torch.txt --find-links DIR.
set -euo pipefail
cd "$(dirname "$0")/.."
folder=${1:?want a folder for the environment}
shift
"${PYTHON:-python3}" -m venv "$folder"
"$folder/bin/python" -m pip install --quiet uv
"$folder/bin/uv" pip install --python "$folder/bin/python" --resolution lowest-direct "$@" -e ".[dev]"
OMP_NUM_THREADS=1 "$folder/bin/python" -m pytest -q -n 2 --dist loadfile --fast
