# Cameras and the channel emulator: no torch, no viewer, no compiler. Build from the repository's root:
#   docker build -f deploy/camera.Dockerfile -t localhost/freshfield-camera .
# For a release, `make images` names the base image by its digest.
ARG BASE=docker.io/library/python:3.11-slim-bookworm
FROM ${BASE} AS build
# One more package index for pip, where there is one.
ARG PIP_EXTRA_INDEX_URL
ENV PIP_DISABLE_PIP_VERSION_CHECK=1 PIP_NO_CACHE_DIR=1 PIP_QUIET=1
WORKDIR /src
# Exactly the wheels whose hashes `make lock` wrote down.
COPY deploy/locks deploy/locks
RUN python -m venv /venv && python -m venv /build \
 && /build/bin/pip install --no-deps --require-hashes -r deploy/locks/build.txt \
 && /venv/bin/pip install --no-deps --require-hashes -r deploy/locks/camera.txt
COPY pyproject.toml README.md LICENSE ./
COPY proto proto
COPY camera_node camera_node
COPY channel_emu channel_emu
COPY edge_server edge_server
COPY deploy/freshfield_up deploy/freshfield_up
COPY deploy/scenarios deploy/scenarios
RUN /build/bin/hatchling build -t wheel -d /dist \
 && /venv/bin/pip install --no-deps --no-index /dist/*.whl \
 && /venv/bin/python -m pip uninstall -y pip setuptools

FROM ${BASE}
RUN useradd --system --create-home --uid 10001 freshfield \
 && install -d -o freshfield -g freshfield /runs && mkdir /app
COPY --from=build /venv /venv
# All that is written lies in /runs, so that the rest may be read-only.
ENV PATH=/venv/bin:$PATH PYTHONUNBUFFERED=1 XDG_CACHE_HOME=/runs/cache \
    OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 OPENCV_FOR_THREADS_NUM=1
WORKDIR /app
USER freshfield
VOLUME /runs
# A node is healthy while it keeps its status file fresh (in a folder that several share, CAMERA names it);
# the emulator's own check is in compose.yaml.
HEALTHCHECK --interval=5s --timeout=3s --start-period=60s --retries=3 \
  CMD ["python", "-m", "freshfield_up.healthy", "--node", "/runs"]
CMD ["camera-node", "--help"]
