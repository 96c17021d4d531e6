#!/bin/sh
# Divides a libtorch as setup.sh leaves it into what images take: image-parts.sh WHOLE DEST
#
# DEST/cpu is what every program needs; DEST/cuda what --device cuda opens at run time, and a file, torch, which tells whether
# there is any of that: an empty directory is more than some builders can copy. Laid over one another they are a whole again.
# DEST/empty is empty.
set -eu
whole=$1 dest=$2
site=$dest/cpu/site
mkdir -p "$site/link/lib" "$dest/cpu/licenses" "$dest/cuda" "$dest/empty"

cd "$whole/site"
for file in link/lib/*.so*; do
    case ${file##*/} in
        libtorch.so) ;; # a text for linkers
        libcaffe2_nvrtc.so | libtorch_cuda_linalg.so) ;; # of the CUDA half
        *) cp -al "$file" "$site/link/lib/" ;;
    esac
done
ln -s site/link/lib "$dest/cpu/lib"
for info in *.dist-info; do
    cp -al "$info" "$dest/cpu/licenses/${info%.dist-info}"
done

echo cpu >"$dest/cuda/torch"
[ -e ../cuda ] || exit 0
echo cuda >"$dest/cuda/torch"
site=$dest/cuda/site
mkdir -p "$site/torch/lib" "$site/link/lib"
ln -s site/torch/lib "$dest/cuda/cuda"
cp -al nvidia "$site/"
for file in torch/lib/*.so*; do
    name=${file##*/}
    if [ -e "$dest/cpu/site/link/lib/$name" ]; then
        ln -s "../../link/lib/$name" "$site/torch/lib/$name" # not twice in an image
    else
        cp -al "$file" "$site/torch/lib/"
    fi
done
# libtorch_cpu.so looks for these two beside itself alone.
for name in libcaffe2_nvrtc.so libtorch_cuda_linalg.so; do
    ln -s "../../torch/lib/$name" "$site/link/lib/$name"
done
