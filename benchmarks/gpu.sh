#!/usr/bin/env bash
# On a machine with a graphics card: are the kernels right there, and how fast is a panorama of 9000x4500?
#
#     benchmarks/gpu.sh [PYTHON]
#
# PYTHON has hugin-abflow's dependencies and its tests' (default: .venv/bin/python; `make test` makes it).
# Prints Markdown for benchmarks/RESULTS.md: the device, the median of five runs end to end, and of one traced
# run the time that flow and blend took on the device, apart from decoding and encoding.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
python=${1:-.venv/bin/python}
export PYTHONPATH=$PWD${PYTHONPATH:+:$PYTHONPATH}
set_=build/benchmarks/speed-9000
profile=$(mktemp)
trap 'rm -f "$profile"' EXIT

# the default device is the fastest graphics card; without one the figures would be the processor's
"$python" -m hugin_abflow --list-devices
if ! "$python" -m hugin_abflow --list-devices | grep -q '(GPU,.*default)'; then
    echo "no graphics card offers OpenCL here: install its driver, or look at \`clinfo\`" >&2
    exit 1
fi

printf '\n## Kernels against their twins\n\n'
tests=(tests/test_opencl.py)
for kernels in kernels/*.cl; do
    name=tests/test_$(basename "$kernels" .cl).py
    if [ -f "$name" ]; then tests+=("$name"); fi
done
"$python" -m pytest -q -p no:cacheprovider "${tests[@]}"

printf '\n## 9000x4500, end to end\n\n'
"$python" benchmarks/speed.py --width 9000 --runs 5 --only hugin-abflow
"$python" -m hugin_abflow "$set_/project.pto" --prefix "$set_/layer" -o "$set_/result-gpu.tif" --profile "$profile"
rm -f "$set_/result-gpu.tif"

printf '\n## Where the time went\n\n'
"$python" benchmarks/phases.py "$profile"
