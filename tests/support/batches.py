"""A stub that replaces nerfbake in tests of batches: its input file selects what it does."""

from __future__ import annotations

from pathlib import Path

# svo IN OUT [...]: copies IN to OUT atomically. The first word of IN selects a failure.
STUB = """#!/bin/sh
report() { printf '%s\\n' "$1" > "/dev/fd/$NERFBAKE_RESULT"; }
fail() { echo "error: $1" >&2; report "{\\"error\\": \\"$(printf '%s' "$1" | sed 's/["\\\\]/\\\\&/g')\\"}"; }
input=$2 output=$3
case " $* " in *" --force "*) force=1 ;; *) force= ;; esac
read -r word rest < "$input"
case $word in
broken) fail "$input: is broken"; exit 1 ;;
usage) fail "no such option"; exit 2 ;;
poor)
    if [ -e "$output.rejected" ] && [ -z "$force" ]; then fail "$output.rejected: exists already"; exit 4; fi
    cp "$input" "$output.rejected"; fail "$output: has a mean PSNR of 20.00 dB"; exit 3 ;;
full) fail "$output: No space left on device"; exit 4 ;;
fault) fail "a fault of nerfbake's own"; exit 70 ;;
killed) kill -9 $$ ;;
silent) exit 0 ;;
once) [ -e "$output.tried" ] || { touch "$output.tried"; kill -9 $$; } ;;
slow) echo begun >> "$output.begun"; trap 'exit 143' TERM; sleep 60 & wait ;;
esac
if [ -e "$output" ] && [ -z "$force" ]; then fail "$output: exists already"; exit 4; fi
echo "$NUMBA_NUM_THREADS" >> "$output.threads"
cp "$input" "$output.part" && mv "$output.part" "$output"
report '{"psnr": 34.93}'
"""


def stub(folder: Path) -> list[str]:
    """Write the stub to a folder and return the command that starts it."""
    script = folder / "stub.sh"
    script.write_text(STUB)
    return ["/bin/sh", str(script)]
