#!/usr/bin/env bash
# A certificate authority of one's own, and certificates for services, routers and clients, with openssl.
#
#     deploy/zenoh/certificates.sh FOLDER authority               ca.pem and ca.key, once; keep ca.key off the servers
#     deploy/zenoh/certificates.sh FOLDER server NAME HOST...     NAME.pem, NAME.key; HOST: names and addresses it is reached by
#     deploy/zenoh/certificates.sh FOLDER client NAME...          NAME.pem, NAME.key for each
#
# NAME becomes the common name, by which access control knows who is there: letters, digits and _.  DAYS sets how long a
# certificate is good for (397; the authority 3650).  What is there already is never overwritten.
set -euo pipefail
umask 077

main() {
    [ $# -ge 2 ] || usage
    local folder=$1 what=$2
    shift 2
    command -v openssl >/dev/null || fail "openssl is not installed"
    mkdir -p "$folder"
    cd "$folder"
    case $what in
        authority) [ $# = 0 ] || usage; authority ;;
        server) [ $# -ge 2 ] || usage; server "$@" ;;
        client) [ $# -ge 1 ] || usage; local name; for name in "$@"; do client "$name"; done ;;
        *) usage ;;
    esac
}

authority() {
    absent ca.key ca.pem
    openssl ecparam -name prime256v1 -genkey -noout -out ca.key
    openssl req -x509 -new -sha256 -key ca.key -days "${DAYS:-3650}" -subj "/CN=factorbus authority" -out ca.pem \
        -addext "basicConstraints=critical,CA:TRUE,pathlen:0" -addext "keyUsage=critical,keyCertSign,cRLSign"
    readable ca.pem
}

# Also for connecting: a service meets routers, routers meet each other.
server() {
    local name=$1 host hosts=()
    shift
    for host in "$@"; do
        if [[ $host =~ ^[0-9.]+$ || $host == *:* ]]; then hosts+=("IP:$host"); else hosts+=("DNS:$host"); fi
    done
    certificate "$name" "extendedKeyUsage=serverAuth,clientAuth" "subjectAltName=$(IFS=,; echo "${hosts[*]}")"
}

client() {
    certificate "$1" "extendedKeyUsage=clientAuth"
}

certificate() {
    local name=$1
    shift
    [[ $name =~ ^[A-Za-z0-9_]{1,55}$ ]] || fail "$name will not do as a name: wanted 1 to 55 letters, digits and _"
    [ -f ca.key ] || fail "there is no ca.key in $PWD; make it first: $0 FOLDER authority"
    absent "$name.key" "$name.pem"
    openssl ecparam -name prime256v1 -genkey -noout -out "$name.key"
    openssl req -new -sha256 -key "$name.key" -subj "/CN=$name" |
        openssl x509 -req -sha256 -CA ca.pem -CAkey ca.key -set_serial "0x$(openssl rand -hex 16)" -days "${DAYS:-397}" \
            -extfile <(printf '%s\n' "basicConstraints=critical,CA:FALSE" "keyUsage=critical,digitalSignature" "$@") \
            -out "$name.pem" 2>/dev/null
    readable "$name.pem"
}

absent() {
    local file
    for file in "$@"; do
        [ ! -e "$file" ] || fail "$PWD/$file is there already; remove it first if it is to be made anew"
    done
}

readable() { chmod 644 "$@"; }

usage() {
    sed -n '2,/^set /{/^#/s/^# \{0,1\}//p}' "$0" >&2
    exit 2
}

fail() {
    echo "certificates: $*" >&2
    exit 1
}

main "$@"
