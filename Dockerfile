# A container image of gs2d; needs no display. scripts/build_container.sh builds and tests it.
#
#   docker build -t gs2d .
#   docker run --rm -u "$(id -u):$(id -g)" -v "$PWD:/work" gs2d train CAPTURE --out runs/x      # on the CPU
#   docker run --rm --gpus all -u "$(id -u):$(id -g)" -v "$PWD:/work" gs2d train CAPTURE --out runs/x
#
# torch's Linux wheels contain CUDA, so the image runs on CPUs and GPUs and takes several gigabytes. A small image for
# CPUs only: --build-arg PIP_EXTRA_INDEX_URL=https://download.pytorch.org/whl/cpu
# Other extras: --build-arg EXTRAS=...   Videos (470 MB more): --build-arg PACKAGES=ffmpeg
ARG BASE=debian:bookworm-slim
FROM ${BASE} AS build
RUN apt-get update \
    && apt-get install -y --no-install-recommends g++ python3-dev python3-venv \
    && rm -rf /var/lib/apt/lists/*
RUN python3 -m venv /opt/gs2d
ENV PATH=/opt/gs2d/bin:$PATH PIP_NO_CACHE_DIR=1 PIP_DISABLE_PIP_VERSION_CHECK=1
ARG PIP_EXTRA_INDEX_URL=
ARG EXTRAS=sfm,texture
# Dependencies first, so that a changed source does not download them again.
WORKDIR /src
COPY pyproject.toml constraints.txt ./
RUN python3 -c 'import os, tomllib; p = tomllib.load(open("pyproject.toml", "rb"))["project"]; \
        extras = [name for name in os.environ["EXTRAS"].split(",") if name]; \
        wanted = [line for name in extras for line in p["optional-dependencies"][name]]; \
        print(*p["dependencies"], *wanted, sep="\n")' > requirements.txt \
    && pip install --no-compile -c constraints.txt -r requirements.txt \
    && pip install -c constraints.txt --target /opt/tools scikit-build-core cmake ninja
# Remove what no run reads: tests, headers and test programs of torch, and the symbol names of its library.
RUN cd /opt/gs2d/lib/python3*/site-packages \
    && rm -rf torch/test torch/include torch/share \
    && find torch/bin -type f ! -name torch_shm_manager -delete \
    && find . -type d -name tests -prune -exec rm -r {} + \
    && strip --strip-unneeded torch/lib/libtorch_cpu.so
COPY . .
# Only the bytecode that a run imports: all of it is 170 MB, and without it each start takes two more seconds.
RUN PATH="/opt/tools/bin:$PATH" PYTHONPATH=/opt/tools pip install --no-deps --no-build-isolation . \
    && python -c 'import gs2d; [getattr(gs2d, name) for name in gs2d.__all__]' \
    && gs2d doctor

FROM ${BASE}
ARG PACKAGES=
RUN apt-get update \
    && apt-get install -y --no-install-recommends python3 ${PACKAGES} \
    && rm -rf /var/lib/apt/lists/*
COPY --from=build /opt/gs2d /opt/gs2d
# Any user id may run it (-u): the home, which holds compiled kernels and caches, is writable for everyone.
RUN mkdir -m 1777 /home/gs2d
ENV PATH=/opt/gs2d/bin:$PATH HOME=/home/gs2d PYTHONDONTWRITEBYTECODE=1 \
    NVIDIA_VISIBLE_DEVICES=all NVIDIA_DRIVER_CAPABILITIES=compute,utility
WORKDIR /work
ENTRYPOINT ["gs2d"]
CMD ["--help"]
