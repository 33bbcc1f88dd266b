#!/bin/sh -e
# Runs a private systemd as process 1 of new namespaces, with the units in $1/units and the program $1/roomcast as /mnt/roomcast. Its mounts and
# files disappear with it. It uses the machine's programs and the control group of the caller.
mount --make-rprivate /
mount -t tmpfs tmpfs /mnt
cp "$1/roomcast" /mnt/roomcast
mkdir /mnt/units /mnt/etc /mnt/work /mnt/state
cp "$1"/units/* /mnt/units
chmod -R a+rX /mnt

# The user of systemd/sysusers.conf, and an invalid configuration.
mount -t overlay -o lowerdir=/etc,upperdir=/mnt/etc,workdir=/mnt/work overlay /etc
echo 'roomcast:x:4711:4711::/nonexistent:/usr/sbin/nologin' >> /etc/passwd
echo 'roomcast:x:4711:' >> /etc/group
mkdir -p /etc/roomcast
echo 'nonsense = 1' > /etc/roomcast/roomcast.toml
mount --bind /mnt/state /var/lib

unified=$([ -e /sys/fs/cgroup/cgroup.controllers ] && echo yes || echo no)
mount -t tmpfs tmpfs /run
umount -l /sys/fs/cgroup
if [ "$unified" = yes ]; then
    mount -t cgroup2 cgroup2 /sys/fs/cgroup
else
    mount -t tmpfs tmpfs /sys/fs/cgroup
    mkdir /sys/fs/cgroup/systemd
    mount -t cgroup -o none,name=systemd cgroup /sys/fs/cgroup/systemd
fi
for systemd in /usr/lib/systemd/systemd /lib/systemd/systemd; do
    # In a container systemd does not change the machine's clock and name.
    [ -x "$systemd" ] && container=roomcast SYSTEMD_UNIT_PATH=/mnt/units exec "$systemd" \
        --system --unit=test.target --log-target=console --log-level=info --show-status=no
done
