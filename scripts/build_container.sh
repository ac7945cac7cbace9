#!/bin/sh
# Build the container image `gs2d` with docker, podman or buildah. Test it without network, as an unnamed user id, with
# a mounted work folder: version, doctor, a short demo, and COLMAP on the demo images. Print the size of the image and
# its folders.
# Usage: scripts/build_container.sh [--debootstrap] [OPTION OF THE BUILDER...]
#
#   scripts/build_container.sh --build-arg PIP_EXTRA_INDEX_URL=https://download.pytorch.org/whl/cpu   # for CPUs only
#
# --debootstrap (as root, on Debian) makes the base image from Debian packages, without an image registry.
# Set BUILDAH_ISOLATION=chroot if the builder cannot create namespaces (in containers and some virtual machines).
set -eu
cd "$(dirname "$0")/.."
tool=""
for candidate in docker podman buildah; do
    if command -v $candidate >/dev/null && $candidate info >/dev/null 2>&1; then
        tool=$candidate
        break
    fi
done
[ -n "$tool" ] ||
    { echo "error: needs docker, podman or buildah that works; on Debian: apt install buildah" >&2; exit 2; }
scratch=$(mktemp -d)
container=""
finish() {
    [ -z "$container" ] || buildah rm "$container" >/dev/null
    rm -rf "$scratch"
}
trap finish EXIT

if [ "${1:-}" = --debootstrap ]; then
    shift
    root="$scratch/root"
    debootstrap --variant=minbase bookworm "$root" >"$scratch/log" 2>&1 || { cat "$scratch/log" >&2; exit 1; }
    # Like Debian's slim image: no manual pages, no translations.
    find "$root/usr/share/doc" -type f ! -name copyright -delete
    rm -rf "$root"/var/cache/apt/archives/*.deb "$root"/var/lib/apt/lists/* "$root"/usr/share/man/* \
        "$root"/usr/share/info/* "$root"/usr/share/locale/*
    for unwanted in 'man/*' 'info/*' 'locale/*' 'doc/*'; do
        echo "path-exclude /usr/share/$unwanted"
    done >"$root/etc/dpkg/dpkg.cfg.d/slim"
    echo "path-include /usr/share/doc/*/copyright" >>"$root/etc/dpkg/dpkg.cfg.d/slim"
    echo 'DPkg::Post-Invoke { "rm -f /var/cache/apt/archives/*.deb /var/cache/apt/*.bin || true"; };' \
        >"$root/etc/apt/apt.conf.d/slim"
    tar -C "$root" -cf "$scratch/root.tar" .
    if [ $tool = buildah ]; then
        container=$(buildah from scratch)
        buildah add -q "$container" "$scratch/root.tar" / >/dev/null
        buildah commit -q "$container" localhost/gs2d-base >/dev/null
        buildah rm "$container" >/dev/null
        container=""
    else
        $tool import "$scratch/root.tar" localhost/gs2d-base >/dev/null
    fi
    rm -rf "$root" "$scratch/root.tar"
    set -- --build-arg BASE=localhost/gs2d-base "$@"
fi

started=$(date +%s)
$tool build "$@" -t gs2d .
echo "built by $tool in $(($(date +%s) - started)) s"

# Run as the current user; root uses another id that has no name in the image.
work="$scratch/work"
mkdir "$work"
user="$(id -u):$(id -g)"
if [ "$(id -u)" = 0 ]; then
    user=4321:4321
    chown $user "$work"
fi
chmod a+x "$scratch"
run() {
    if [ $tool = buildah ]; then
        buildah run --network none --user "$user" -v "$work:/work" "$container" -- "$@"
    else
        program=$1
        shift
        $tool run --rm --network none -u "$user" -v "$work:/work" --entrypoint "$program" gs2d "$@"
    fi
}
[ $tool != buildah ] || container=$(buildah from --pull-never localhost/gs2d)
run gs2d --version
run gs2d doctor | tee "$scratch/doctor"
grep -q 'yes  cpu' "$scratch/doctor" || { echo "error: the image must have the native kernels" >&2; exit 1; }
run gs2d demo --out demo --schedule-scale 0.01 --quiet
run gs2d poses demo/capture/train --out poses --quiet
for made in demo/mesh.ply demo/report.html demo/scene.html poses/sparse/0/images.bin; do
    [ -s "$work/$made" ] || { echo "error: $made must be in the work folder" >&2; exit 1; }
done
echo "cameras found of $(ls "$work/poses/images" | wc -l) photographs, as user $user, without network and display"

# Folders of the image by size, MB.
run sh -c 'du -xsm /usr /opt/gs2d; du -xm --max-depth=1 /opt/gs2d/lib/python3*/site-packages | sort -rn | sed -n 2,8p'
if [ $tool = buildah ]; then
    buildah push -q localhost/gs2d "docker-archive:$scratch/image.tar:gs2d"
else
    $tool save gs2d -o "$scratch/image.tar"
fi
large=$(($(wc -c <"$scratch/image.tar") / 1000000))
small=$(($(gzip -6 <"$scratch/image.tar" | wc -c) / 1000000))
echo "image: $large MB, $small MB compressed"
