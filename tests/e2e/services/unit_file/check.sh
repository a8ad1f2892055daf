# Run by the systemd that boot.sh starts, as root and without limits: starts slrig.service, scans with it, and stops it.
set -u
cd /run/out
systemd-sysusers /etc/sysusers.d/slrig.conf
id slrig >id.txt 2>&1
# Nodes of classes that the unit allows, and of one that it does not; there need be no devices behind them.
while read -r number name; do
  case $name in
  hidraw | usb_device | video4linux | ttyACM | ttyUSB | ttyS) mknod -m 666 "/dev/allowed-$name" c "$number" 200 ;;
  mem) mknod -m 666 /dev/denied-mem c 1 11 ;;
  esac
done </proc/devices
systemctl start probe.service
# A graphical session of somebody else's, that lets nobody in before it is told to. Its abstract socket is left out, as
# newer servers have none.
if command -v Xvfb >/dev/null && command -v xhost >/dev/null && command -v xauth >/dev/null; then
  export XAUTHORITY=/run/cookie
  (umask 077 && xauth add :0 . 0123456789abcdef0123456789abcdef)
  Xvfb :0 -noreset -auth $XAUTHORITY -nolisten local -nolisten tcp >/dev/null 2>&1 &
  tries=0
  until DISPLAY=:0 xhost >/dev/null 2>&1 || [ $((tries += 1)) -gt 100 ]; do sleep 0.1; done
  systemctl start screen.service
  mv screen.txt screen-before.txt
  DISPLAY=:0 xhost +si:localuser:slrig
  systemctl start screen.service
fi
systemctl start slrig.service
systemctl show -p ActiveState -p Result slrig.service >started.txt
tries=0
until curl -sf http://127.0.0.1:8731/livez >/dev/null || [ $((tries += 1)) -gt 300 ]; do sleep 0.2; done
export SLRIG_API_KEY="the key of the tests"
/opt/slrig/bin/slrig scan --output /run/out/scan >scan.txt 2>&1
echo "exit code $?" >>scan.txt
stat -c '%a %U %n' /var/lib/slrig /var/lib/slrig/data /var/lib/slrig/data/slrig.sqlite >modes.txt
systemctl stop slrig.service
systemctl show -p ActiveState -p Result -p ExecMainStatus slrig.service >stopped.txt
systemctl exit --force
