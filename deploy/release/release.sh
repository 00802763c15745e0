#!/usr/bin/env bash
# Builds what is uploaded, from the last commit, and checks it.  It uploads nothing.
#
#     deploy/release/release.sh PYTHON FOLDER [--rehearse]        PYTHON makes the environments, 3.11 or later
#
# FOLDER gets the source distribution and the wheel, factorbus-VERSION.cdx.json (what a service installs, CycloneDX),
# factorbus-VERSION.provenance.json (of which commit, built by what: in-toto, SLSA v1), SHA256SUMS and its signature.
# Wanted: no change that is not committed, a section of this version in CHANGELOG.md, a key to sign with (`git config
# user.signingkey`), and FACTORBUS_URL, the address of the project: README's links and the project's URLs begin with it.
# --rehearse goes without these four, tags nothing and signs nothing.
set -euo pipefail

main() {
    # A word that is not known is refused: what was meant to be a rehearsal would sign and tag.
    if [ $# -lt 2 ] || [ $# -gt 3 ] || [ "${3:---rehearse}" != --rehearse ]; then
        echo "wanted: deploy/release/release.sh PYTHON FOLDER [--rehearse], seen: $*" >&2
        return 2
    fi
    python=$1 out=$2 rehearse=${3:-}
    here=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)
    root=$(cd "$here/../.." && pwd)
    cd "$root"
    version=$(sed -n 's/^__version__ = "\(.*\)"$/\1/p' proto/factorbus/proto/version.py)
    [ "$rehearse" = --rehearse ] || may_be_released
    mkdir -p "$out"
    out=$(cd "$out" && pwd)
    rm -f "$out"/factorbus-* "$out"/SHA256SUMS*
    work=$(mktemp -d)
    # Expanded now: the variable is gone by the time the trap runs.
    # shellcheck disable=SC2064
    trap "rm -rf '$work'" EXIT
    tools
    build
    describe
    try_them
    bill_of_materials
    "$work/tools/bin/python" "$here/provenance.py" "$root" "$out" "$version" > "$out/factorbus-$version.provenance.json"
    (cd "$out" && sha256sum factorbus-* > SHA256SUMS)
    [ "$rehearse" = --rehearse ] || sign
    echo "release: $version of $(git rev-parse --short HEAD) is in $out"
    ls -l "$out"
}

may_be_released() {
    local lacking=()
    [ -z "$(git status --porcelain)" ] || lacking+=("changes are not committed: commit them, or take them back")
    grep -q "^## \[$version\]" CHANGELOG.md || lacking+=("CHANGELOG.md has no section [$version]: rename [Unreleased]")
    git rev-parse -q --verify "refs/tags/v$version" > /dev/null && lacking+=("v$version is tagged already: raise version.py")
    [ -n "$(git config user.signingkey)" ] || lacking+=("no key to sign with: git config user.signingkey KEY")
    [[ ${FACTORBUS_URL:-} == https://* ]] || lacking+=("FACTORBUS_URL is '${FACTORBUS_URL:-}': the project's https address is wanted")
    [ ${#lacking[@]} = 0 ] && return 0
    printf 'release: %s\n' "${lacking[@]}" "to try all else: --rehearse" >&2
    return 1
}

tools() {
    "$python" -m venv "$work/tools"
    "$work/tools/bin/python" -m pip install --quiet --disable-pip-version-check \
        "build>=1.2" "twine>=6" "cyclonedx-bom>=7" "hatchling>=1.27"
}

# From the commit, not from the folder; twice, since anybody must be able to build the same bits.
build() {
    local turn
    SOURCE_DATE_EPOCH=$(git log -1 --format=%ct)
    export SOURCE_DATE_EPOCH
    for turn in one two; do
        git clone --quiet --no-hardlinks "$root" "$work/$turn"
        "$work/tools/bin/python" -m build --no-isolation --outdir "$work/dist-$turn" "$work/$turn" > "$work/build.log" 2>&1 \
            || { cat "$work/build.log" >&2; return 1; }
    done
    diff <(cd "$work/dist-one" && sha256sum -- *) <(cd "$work/dist-two" && sha256sum -- *) >&2 \
        || { echo "release: two builds of one commit differ; wanted the same bits" >&2; return 1; }
    cp "$work"/dist-one/* "$out"
}

describe() {
    "$work/tools/bin/twine" check --strict "$out"/factorbus-*.whl "$out"/factorbus-*.tar.gz
}

# With each Python from 3.11 on that is here: the wheel with a service in it, wheels only, and the demo.
try_them() {
    local minor found tried=0
    for minor in 11 12 13 14; do
        found=$(find_python "3.$minor")
        if [ -z "$found" ]; then
            echo "release: Python 3.$minor is not here, not tried"
            continue
        fi
        "$found" -m venv "$work/3.$minor"
        "$work/3.$minor/bin/python" -m pip install --quiet --disable-pip-version-check --only-binary :all: \
            "$(echo "$out"/factorbus-*.whl)[service,viz]"
        (cd "$work" && "3.$minor/bin/factorbus" demo --poses 100 --workers 1 > demo.log 2>&1) \
            || { cat "$work/demo.log" >&2; return 1; }
        echo "release: Python 3.$minor runs the demo"
        tried=$((tried + 1))
        newest=$work/3.$minor
    done
    [ $tried -gt 0 ] || { echo "release: no Python from 3.11 on was found to try it with" >&2; return 1; }
}

find_python() {
    local each
    for each in "$(command -v "python$1" || true)" "$HOME"/.pyenv/versions/"$1".*/bin/python; do
        [ -n "$each" ] && "$each" -c "import sys, venv; sys.exit('%d.%d' % sys.version_info[:2] != '$1')" 2> /dev/null \
            && { echo "$each"; return 0; }
    done
    return 0
}

bill_of_materials() {
    "$work/tools/bin/cyclonedx-py" environment --output-reproducible --mc-type library --pyproject pyproject.toml \
        --output-file "$out/factorbus-$version.cdx.json" "$newest/bin/python"
    "$work/tools/bin/python" "$here/bill_of_materials.py" "$out/factorbus-$version.cdx.json" "$version"
}

sign() {
    gpg --batch --armor --local-user "$(git config user.signingkey)" --detach-sign "$out/SHA256SUMS"
    git tag --sign --message "factorbus $version" "v$version"
    echo "release: tag v$version is signed; push it, then upload: twine upload $out/factorbus-*.whl $out/factorbus-*.tar.gz"
}

main "$@"
