#!/bin/sh
# Makes the Go package of the contract's messages: generate.sh [FOLDER], by default beside this script.
set -eu
here=$(cd "$(dirname "$0")" && pwd)
proto=${PLANTD_PROTO:-$here/../../proto}
out=${1:-$here}
module=plantd-example
set --
for file in "$proto"/plantd/v1/*.proto; do
    name=M${file#"$proto"/}=$module/plantdv1
    set -- "$@" "--go_opt=$name" "--go-grpc_opt=$name"
done
protoc -I "$proto" "--go_out=$out" "--go-grpc_out=$out" \
    "--go_opt=module=$module" "--go-grpc_opt=module=$module" "$@" "$proto"/plantd/v1/*.proto
