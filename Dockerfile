# gs2d in a container; no display is needed. scripts/build_container.sh builds this and tries it.
#
#   docker build -t gs2d .
#   docker run --rm -u "$(id -u):$(id -g)" -v "$PWD:/work" gs2d train CAPTURE --out runs/x      # on the CPU
#   docker run --rm --gpus all -u "$(id -u):$(id -g)" -v "$PWD:/work" gs2d train CAPTURE --out runs/x
#
# torch's Linux wheels carry CUDA: the image runs on both, at several gigabytes. For a small one that runs on CPUs only,
# name an index that has torch's CPU builds: --build-arg PIP_EXTRA_INDEX_URL=https://download.pytorch.org/whl/cpu
# Fewer or other extras: --build-arg EXTRAS=...   Videos (470 MB more): --build-arg PACKAGES=ffmpeg
ARG BASE=debian:bookworm-slim
FROM ${BASE} AS build
RUN apt-get update \
    && apt-get install -y --no-install-recommends g++ python3-dev python3-venv \
    && rm -rf /var/lib/apt/lists/*
RUN python3 -m venv /opt/gs2d
ENV PATH=/opt/gs2d/bin:$PATH PIP_NO_CACHE_DIR=1 PIP_DISABLE_PIP_VERSION_CHECK=1
ARG PIP_EXTRA_INDEX_URL=
ARG EXTRAS=sfm,texture,view
# Dependencies first: a change of the sources does not download them again.
WORKDIR /src
COPY pyproject.toml constraints.txt ./
RUN python3 -c 'import os, tomllib; p = tomllib.load(open("pyproject.toml", "rb"))["project"]; \
        extras = [name for name in os.environ["EXTRAS"].split(",") if name]; \
        wanted = [line for name in extras for line in p["optional-dependencies"][name]]; \
        print(*p["dependencies"], *wanted, sep="\n")' > requirements.txt \
    && pip install --no-compile -c constraints.txt -r requirements.txt \
    && pip install -c constraints.txt --target /opt/tools scikit-build-core cmake ninja
# What no run reads: tests, the headers and programs of torch's own tests, and the names of functions in its library.
RUN cd /opt/gs2d/lib/python3*/site-packages \
    && rm -rf torch/test torch/include torch/share \
    && find torch/bin -type f ! -name torch_shm_manager -delete \
    && find . -type d -name tests -prune -exec rm -r {} + \
    && strip --strip-unneeded torch/lib/libtorch_cpu.so
COPY . .
# Bytecode of what a run imports alone: all of it is 170 MB, and without any each start takes two seconds more.
RUN PATH="/opt/tools/bin:$PATH" PYTHONPATH=/opt/tools pip install --no-deps --no-build-isolation . \
    && python -c 'import gs2d; [getattr(gs2d, name) for name in gs2d.__all__]' \
    && gs2d doctor

FROM ${BASE}
ARG PACKAGES=
RUN apt-get update \
    && apt-get install -y --no-install-recommends python3 ${PACKAGES} \
    && rm -rf /var/lib/apt/lists/*
COPY --from=build /opt/gs2d /opt/gs2d
# Any user id may run it (-u): compiled CUDA kernels and the caches of libraries go to a home that everyone may write.
RUN mkdir -m 1777 /home/gs2d
ENV PATH=/opt/gs2d/bin:$PATH HOME=/home/gs2d PYTHONDONTWRITEBYTECODE=1 \
    NVIDIA_VISIBLE_DEVICES=all NVIDIA_DRIVER_CAPABILITIES=compute,utility
WORKDIR /work
ENTRYPOINT ["gs2d"]
CMD ["--help"]
