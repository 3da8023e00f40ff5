#!/bin/bash
# First process of the guest: devices, CAN modules, vcan0; then job.sh, its exit status, power off.
# $GUEST (folder of the unpacked packages) and $JOB (folder of this call) are on the kernel's command line.
box="$GUEST/bin/busybox"
modules=$(echo "$GUEST"/usr/lib/uml/modules/*/kernel)

set_up() {
  "$box" mount -t proc none /proc
  "$box" mount -t sysfs none /sys
  "$box" mount -t devtmpfs none /dev
  "$box" mkdir /dev/pts /dev/shm
  "$box" mount -t devpts none /dev/pts
  "$box" mount -t tmpfs none /dev/shm
  for name in fd stdin:fd/0 stdout:fd/1 stderr:fd/2; do
    "$box" ln -sfn "/proc/self/${name#*:}" "/dev/${name%:*}"
  done
  for module in net/can/can net/can/can-raw net/can/can-gw drivers/net/can/dev/can-dev drivers/net/can/vcan \
                drivers/net/can/vxcan net/sched/sch_tbf; do
    "$box" insmod "$modules/$module.ko"
  done
  "$box" ip link set lo up
  "$box" ip link add vcan0 type vcan
  "$box" ip link set vcan0 up
  "$box" stty -F /dev/tty1 raw
  "$box" stty -F /dev/tty2 raw
}

set_up >"$JOB/set_up.log" 2>&1
# through pipes, so that no program treats the consoles of the guest as a terminal
{ { bash "$JOB/job.sh" </dev/null 2>&3 3>&-; echo $? >"$JOB/status"; } | "$box" cat >/dev/tty1; } 3>&1 |
  "$box" cat >/dev/tty2
"$box" sync
"$box" poweroff -f
