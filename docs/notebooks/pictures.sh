#!/usr/bin/env bash
# Draws the pictures of the notebooks again, into docs/figures:  docs/notebooks/pictures.sh BIN
set -euo pipefail

here=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)
bin=$(cd "$1" && pwd)
mkfifo "${work:=$(mktemp -d)}/keep" "$work/ready"
"$bin/factorbus" serve --listen tcp/127.0.0.1:0 --until-eof < "$work/keep" > "$work/ready" &
exec 3> "$work/keep" 4< "$work/ready"
read -r _ FACTORBUS_ENDPOINT <&4
export FACTORBUS_ENDPOINT
cd "$here/../figures"
for each in "$here"/*.py; do "$bin/python" "$each"; done
exec 3>&-
wait
rm -r "$work"
