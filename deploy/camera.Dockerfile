# Cameras and the channel emulator: no torch, no viewer, no compiler. Build from the repository's root:
#   docker build -f deploy/camera.Dockerfile -t localhost/freshfield-camera .
FROM docker.io/library/python:3.11-slim-bookworm AS build
# One more package index for pip, where there is one.
ARG PIP_EXTRA_INDEX_URL
WORKDIR /src
COPY pyproject.toml README.md LICENSE ./
COPY proto proto
COPY camera_node camera_node
COPY channel_emu channel_emu
COPY edge_server edge_server
COPY deploy/freshfield_up deploy/freshfield_up
COPY deploy/scenarios deploy/scenarios
RUN python -m venv /venv \
 && /venv/bin/python -m pip install --disable-pip-version-check --no-cache-dir -q . \
 && /venv/bin/python -m pip uninstall --disable-pip-version-check -y -q pip setuptools

FROM docker.io/library/python:3.11-slim-bookworm
RUN useradd --system --create-home --uid 10001 freshfield \
 && install -d -o freshfield -g freshfield /runs
COPY --from=build /venv /venv
ENV PATH=/venv/bin:$PATH PYTHONUNBUFFERED=1 \
    OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 OPENCV_FOR_THREADS_NUM=1
WORKDIR /app
USER freshfield
VOLUME /runs
# A node is healthy while it keeps its status file fresh (in a folder that several share, CAMERA names it);
# the emulator's own check is in compose.yaml.
HEALTHCHECK --interval=5s --timeout=3s --start-period=60s --retries=3 \
  CMD ["python", "-m", "freshfield_up.healthy", "--node", "/runs"]
CMD ["camera-node", "--help"]
