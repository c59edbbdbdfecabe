"""A command that does what its input says, in place of nerfbake: for batches of many items."""

from __future__ import annotations

from pathlib import Path

# svo IN OUT [...]: copies IN to OUT, whole or not at all; the first word of IN says what goes wrong instead.
STUB = """#!/bin/sh
input=$2 output=$3
case " $* " in *" --force "*) force=1 ;; *) force= ;; esac
read -r word rest < "$input"
case $word in
broken) echo "error: $input: is broken" >&2; exit 1 ;;
usage) echo "error: no such option" >&2; exit 2 ;;
poor)
    if [ -e "$output.rejected" ] && [ -z "$force" ]; then echo "error: $output.rejected: exists already" >&2; exit 4; fi
    cp "$input" "$output.rejected"; echo "error: $output: has a mean PSNR of 20.00 dB" >&2; exit 3 ;;
full) echo "error: $output: No space left on device" >&2; exit 4 ;;
fault) echo "error: a fault of nerfbake's own" >&2; exit 70 ;;
killed) kill -9 $$ ;;
silent) exit 0 ;;
once) [ -e "$output.tried" ] || { touch "$output.tried"; kill -9 $$; } ;;
slow) echo begun >> "$output.begun"; trap 'exit 143' TERM; sleep 60 & wait ;;
esac
if [ -e "$output" ] && [ -z "$force" ]; then echo "error: $output: exists already" >&2; exit 4; fi
echo "$NUMBA_NUM_THREADS" >> "$output.threads"
cp "$input" "$output.part" && mv "$output.part" "$output"
echo "$output: 34.93 dB against $input" >&2
"""


def stub(folder: Path) -> list[str]:
    """What starts it."""
    script = folder / "stub.sh"
    script.write_text(STUB)
    return ["/bin/sh", str(script)]
