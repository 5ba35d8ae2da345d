# The edge server: torch, kernels, page. Build from the repository's root:
#   docker build -f deploy/edge.Dockerfile -t localhost/freshfield-edge .
# Without a GPU, add --build-arg TORCH=cpu --build-arg TORCH_INDEX=... with PyTorch's CPU wheel index: the image is
# 3 GB smaller. For a release, `make images` names the base image by its digest.
ARG BASE=docker.io/library/python:3.11-slim-bookworm
FROM ${BASE} AS build
# One more package index for pip, where there is one; the build of torch, and one more index to find it.
ARG PIP_EXTRA_INDEX_URL
ARG TORCH=cuda
ARG TORCH_INDEX
ENV PIP_DISABLE_PIP_VERSION_CHECK=1 PIP_NO_CACHE_DIR=1 PIP_QUIET=1
WORKDIR /src
# Exactly the wheels whose hashes `make lock` wrote down.
COPY deploy/locks deploy/locks
RUN python -m venv /venv && python -m venv /build \
 && /build/bin/pip install --no-deps --require-hashes -r deploy/locks/build.txt \
 && /venv/bin/pip install --no-deps --require-hashes ${TORCH_INDEX:+--extra-index-url $TORCH_INDEX} \
      -r deploy/locks/torch-$TORCH.txt -r deploy/locks/edge.txt
COPY pyproject.toml README.md LICENSE ./
COPY proto proto
COPY camera_node camera_node
COPY channel_emu channel_emu
COPY edge_server edge_server
COPY deploy/freshfield_up deploy/freshfield_up
COPY deploy/scenarios deploy/scenarios
RUN /build/bin/hatchling build -t wheel -d /dist \
 && /venv/bin/pip install --no-deps --no-index /dist/*.whl

FROM ${BASE}
RUN useradd --system --create-home --uid 10001 freshfield \
 && install -d -o freshfield -g freshfield /runs
COPY --from=build /venv /venv
# Compiled kernels are kept in the user's home: the installed packages are not theirs to write to.
ENV PATH=/venv/bin:$PATH PYTHONUNBUFFERED=1 \
    NUMBA_CACHE_DIR=/home/freshfield/.cache/numba MPLCONFIGDIR=/home/freshfield/.cache/matplotlib
WORKDIR /app
USER freshfield
# The field's kernels, compiled for this machine's processor; on another kind of processor they are compiled
# again at the first start.
RUN freshfield warm-up
VOLUME /runs
EXPOSE 7000 8080
HEALTHCHECK --interval=5s --timeout=3s --start-period=120s --retries=3 \
  CMD ["python", "-m", "freshfield_up.healthy", "--serving", "127.0.0.1:7000"]
CMD ["edge-server", "--help"]
