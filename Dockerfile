# gs2d in a container; no display is needed.
#
#   docker build -t gs2d .
#   docker run --rm -u "$(id -u):$(id -g)" -v "$PWD:/work" gs2d train CAPTURE --out runs/x      # on the CPU
#   docker run --rm --gpus all -u "$(id -u):$(id -g)" -v "$PWD:/work" gs2d train CAPTURE --out runs/x
#
# torch's Linux wheels carry CUDA: the image runs on both, at several gigabytes. For a small one that runs on CPUs only,
# name an index that has torch's CPU builds: --build-arg PIP_EXTRA_INDEX_URL=https://download.pytorch.org/whl/cpu  Fewer or other extras: --build-arg EXTRAS=...
FROM debian:bookworm-slim AS build
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
        wanted = [name for extra in os.environ["EXTRAS"].split(",") if extra for name in p["optional-dependencies"][extra]]; \
        print(*p["dependencies"], *wanted, sep="\n")' > requirements.txt \
    && pip install -c constraints.txt -r requirements.txt \
    && pip install -c constraints.txt --target /opt/tools scikit-build-core cmake ninja
COPY . .
RUN PATH="/opt/tools/bin:$PATH" PYTHONPATH=/opt/tools pip install --no-deps --no-build-isolation .

FROM debian:bookworm-slim
RUN apt-get update \
    && apt-get install -y --no-install-recommends python3 \
    && rm -rf /var/lib/apt/lists/*
COPY --from=build /opt/gs2d /opt/gs2d
# Any user id may run it (-u): compiled CUDA kernels and the caches of libraries go to a home that everyone may write.
RUN mkdir -m 1777 /home/gs2d
ENV PATH=/opt/gs2d/bin:$PATH HOME=/home/gs2d PYTHONDONTWRITEBYTECODE=1 \
    NVIDIA_VISIBLE_DEVICES=all NVIDIA_DRIVER_CAPABILITIES=compute,utility
WORKDIR /work
ENTRYPOINT ["gs2d"]
CMD ["--help"]
