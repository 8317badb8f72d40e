#!/bin/sh
# Says its argument once a second until it is asked to stop.
trap 'echo "asked to stop"; kill "$sleeper" 2>/dev/null; exit 0' INT TERM
while :; do
    echo "$1 from $(uname -n)"
    sleep 1 &
    sleeper=$!
    wait "$sleeper"
done
