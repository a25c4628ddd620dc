#!/bin/sh
# acsar-gym in a container. A container's end kills all that runs in it, and so the watchdog process, which
# commands the wheels to stop where the program itself was killed. So this waits for it.
trap : TERM INT HUP QUIT # the program gets these signals as well, and decides what they mean
acsar-gym "$@"
code=$?
[ "$code" -lt 128 ] || sleep 1
exit "$code"
