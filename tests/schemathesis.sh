#!/usr/bin/env bash
# Sets the API document against the running service, with schemathesis: all phases, all checks.
#
#   pip install schemathesis && cargo build --release && tests/schemathesis.sh [further arguments of `schemathesis run`]
#
# MODALWATCH is the program (target/release/modalwatch), SCHEMATHESIS the tester, EXAMPLES the cases for an operation and phase.
set -euo pipefail
here=$(cd "$(dirname "$0")" && pwd)
program=${MODALWATCH:-$here/../target/release/modalwatch}
tester=${SCHEMATHESIS:-schemathesis}
if ! command -v "$tester" > /dev/null; then
    echo "skipped: $tester is not installed (pip install schemathesis)"
    exit 0
fi
folder=$(mktemp -d)
service=
finish() {
    if [ -n "$service" ]; then
        # What it was asked to train could keep it for a while.
        kill "$service" 2> /dev/null || true
        for _ in $(seq 20); do if ! kill -0 "$service" 2> /dev/null; then break; fi; sleep 0.1; done
        kill -KILL "$service" 2> /dev/null || true
        wait "$service" 2> /dev/null || true
    fi
    rm -rf "$folder"
}
trap finish EXIT

# The paper's case 1: five batches, an undamaged reference, alarms.
"$program" demo --exit --listen 127.0.0.1:0 --data-dir "$folder/data" > "$folder/demo.log" 2>&1 || {
    cat "$folder/demo.log"
    exit 1
}
# Access is on, with a token outside the database: one that a generated request makes or revokes does not end the run.
"$program" token file "$folder/admin-token" > /dev/null 2>&1
TOKEN=$(cat "$folder/admin-token")
export TOKEN
# More wrong tokens than a service takes from one address in a minute are tried on purpose.
MODALWATCH_ADMIN_TOKEN_FILE=$folder/admin-token MODALWATCH__HTTP__RATE_LIMIT__FAILED_AUTHENTICATIONS_PER_MIN=0 \
    MODALWATCH__LOG__LEVEL=warn "$program" serve --listen 127.0.0.1:0 --data-dir "$folder/data" \
    > "$folder/address" 2> "$folder/service.log" &
service=$!
url=
for _ in $(seq 100); do
    url=$(sed -n 's/.*listens on //p' "$folder/address")
    if [ -n "$url" ]; then break; fi
    sleep 0.1
done
if [ -z "$url" ]; then
    cat "$folder/service.log"
    exit 1
fi

# A diagnosis, for the operations that need one; the settings take its id from the environment.
DIAGNOSIS=$(curl -sS -H "authorization: Bearer $TOKEN" "$url/v1/structures/three-dof/diagnoses" -H 'content-type: application/json' -d '{}' |
    sed -n 's/.*"diagnosis":"\([^"]*\)".*/\1/p')
export DIAGNOSIS
for _ in $(seq 600); do
    if ! curl -sS -H "authorization: Bearer $TOKEN" "$url/v1/diagnoses/$DIAGNOSIS" | grep -q '"state":"running"'; then break; fi
    sleep 0.1
done

status=0
cd "$here/schemathesis"
"$tester" --config-file schemathesis.toml run "$url/openapi.json" \
    --workers 1 --max-examples "${EXAMPLES:-40}" --no-color "$@" || status=$?
rm -rf .schemathesis .hypothesis
if [ "$status" -ne 0 ]; then
    echo "the log of the service:"
    tail -n 20 "$folder/service.log"
fi
exit "$status"
