#!/usr/bin/env bash
# Runs Python of aarch64 (Raspberry Pi, Jetson) with this clone in it, on a processor of another kind: emulated by qemu-user.
#
#     deploy/setup/try-aarch64.sh FOLDER ARGUMENTS...        FOLDER keeps the system, the packages and the compiled kernels
#
#     deploy/setup/try-aarch64.sh /var/tmp/arm -m factorbus.cli replay intel.g2o --in-process --json
#     deploy/setup/try-aarch64.sh /var/tmp/arm -m pytest -p no:cacheprovider tests/solver/test_cholesky_kernels.py
#
# Wanted: Debian's debootstrap and qemu-user-static, as root.  All kernels take some 20 minutes to compile, tests ten to
# sixty times as long as on the machine itself; FACTORBUS_EXAMPLES=2 tries properties at two examples each.
set -euo pipefail

main() {
    [ $# -ge 2 ] || { sed -n 's/^# *//; /try-aarch64.sh FOLDER/p' "${BASH_SOURCE[0]}" >&2; return 2; }
    local folder=$1 here needed
    shift
    for needed in debootstrap qemu-aarch64-static; do
        command -v "$needed" > /dev/null || { echo "$needed is not here: apt install debootstrap qemu-user-static" >&2; return 1; }
    done
    here=$(cd "$(dirname "${BASH_SOURCE[0]}")/../.." && pwd)
    mkdir -p "$folder/home"
    folder=$(cd "$folder" && pwd)
    [ -e "$folder/system/.ready" ] || system "$folder"
    [ -e "$folder/packages/.ready" ] || packages "$folder" "$here"
    export QEMU_CPU=${QEMU_CPU:-cortex-a72} HOME=$folder/home FACTORBUS_CACHE=$folder/kernels PYTHONDONTWRITEBYTECODE=1
    cd "$here"
    start "$folder" "$here"
    "$folder/python" "$@"
}

# What runs Python, also where Python is to start another one, as the system itself cannot execute that file; and where
# each of them finds the packages and this clone.
start() {
    local found=$1/system/usr/lib/python3/dist-packages
    printf '#!/usr/bin/env bash\nexec qemu-aarch64-static -L "%s/system" "%s/system/usr/bin/python3.11" "$@"\n' "$1" "$1" > "$1/python"
    chmod +x "$1/python"
    printf '%s\n' "$1/packages" "$2"/{proto,service,workers,clients} "import sys; sys.executable = '$1/python'" > "$found/clone.pth"
}

# The first stage of debootstrap unpacks what every system has; what else it has fetched is unpacked here.
system() {
    rm -rf "$1/system"
    debootstrap --arch=arm64 --foreign --variant=minbase --include=python3 bookworm "$1/system"
    local each
    for each in "$1"/system/var/cache/apt/archives/*.deb; do
        dpkg-deb --extract "$each" "$1/system"
    done
    touch "$1/system/.ready"
}

# What pyproject.toml says that a service needs, as wheels of aarch64; pip of this machine fetches them.
packages() {
    rm -rf "$1/packages"
    local needed platform
    mapfile -t needed < <(python3 - "$2/pyproject.toml" <<'EOF'
import sys, tomllib

with open(sys.argv[1], "rb") as file:
    project = tomllib.load(file)["project"]
extras = project["optional-dependencies"]
tests = ("gtsam", "hypothesis", "pytest>", "pytest-timeout")
wanted = [each for each in [*extras["dev"], *extras["bench"]] if each.startswith(tests)]
print(*project["dependencies"], *extras["service"], *wanted, sep="\n")
EOF
    )
    for platform in manylinux_2_28 manylinux_2_27 manylinux_2_17 manylinux2014 manylinux_2_5; do
        set -- "$@" --platform "${platform}_aarch64"
    done
    python3 -m pip install --quiet --disable-pip-version-check --target "$1/packages" --python-version 3.11 \
        --implementation cp --only-binary :all: "${@:3}" "${needed[@]}"
    touch "$1/packages/.ready"
}

main "$@"
