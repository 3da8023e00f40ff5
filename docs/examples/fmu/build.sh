#!/bin/sh
# Compiles all C files of this folder as an FMU of FMI 2.0 for this machine: unit.fmu in the current folder.
# The headers of the standard are those of the package fmpy (pip install 'rollerrig[fmu]').
set -e
here=$(cd "$(dirname "$0")" && pwd)
work=$(mktemp -d)
trap 'rm -r "$work"' EXIT
if ! python -c 'import fmpy' 2>/dev/null; then
  echo "build.sh: the headers of FMI are missing; install them with: pip install 'rollerrig[fmu]'" >&2
  exit 1
fi
headers=$(python -c 'import fmpy, pathlib; print(pathlib.Path(fmpy.__file__).parent / "c-code")')

mkdir -p "$work/binaries/linux64"
# -z defs: a function that no file defines is an error now, and not when the FMU is loaded
cc -shared -fPIC -O2 -Wl,-z,defs "-I$headers" -o "$work/binaries/linux64/unit.so" "$here"/*.c -lm
cp "$here/modelDescription.xml" "$work"
(cd "$work" && python -m zipfile -c unit.fmu modelDescription.xml binaries)
mv "$work/unit.fmu" unit.fmu
