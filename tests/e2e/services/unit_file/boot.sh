# Boots systemd in namespaces of its own, above a copy of this machine's files that is thrown away.
# $1: a cgroup of its own; $2: a folder with etc/ and opt/ to add; $3: where what is found comes out; $4...: folders that are needed.
set -eu
cgroup=$1 added=$2 out=$3
shift 3
mkdir "$cgroup"
echo $$ >"$cgroup/cgroup.procs"
export added out
exec unshare --mount --pid --fork --uts --ipc --net --cgroup --kill-child sh -euc '
  mount --make-rprivate /
  above=$(mktemp -d)
  mount -t tmpfs none "$above"
  mkdir "$above/changed" "$above/work" "$above/root"
  mkdir "$above/places" "$above/places-work"
  root=$above/root
  mount -t overlay overlay -o "lowerdir=/,upperdir=$above/changed,workdir=$above/work" "$root"
  mount -t proc proc "$root/proc"
  mount -t sysfs sysfs "$root/sys"
  mount -t cgroup2 none "$root/sys/fs/cgroup"
  mount -t tmpfs none "$root/dev"
  mkdir "$root/dev/pts" "$root/dev/shm"
  mount -t tmpfs -o mode=1777 none "$root/dev/shm"
  for node in null zero full random urandom tty; do cp -a "/dev/$node" "$root/dev/"; done
  for place in run tmp; do mount -t tmpfs none "$root/$place"; done
  rm -rf "$root/etc/systemd/system" "$root/var/lib/slrig"
  cp -r "$added/." "$root/"
  for place in "$@"; do
    mkdir -p "$root/opt/seen$place" "$above/places$place" "$above/places-work$place"
    mount -t overlay overlay -o "lowerdir=$place,upperdir=$above/places$place,workdir=$above/places-work$place" "$root/opt/seen$place"
    # The kernels that are compiled already are taken where they may be written, too.
    find "$root/opt/seen$place" -name __pycache__ -path "*slrig*" -exec chmod 777 {} +
  done
  mkdir "$root/run/out"
  mount --bind "$out" "$root/run/out"
  exec chroot "$root" env -i container=nest PATH=/usr/sbin:/usr/bin:/sbin:/bin \
    /lib/systemd/systemd --system --unit=check.target --log-target=console --show-status=no
' boot "$@"
