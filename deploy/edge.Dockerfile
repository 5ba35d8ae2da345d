# The edge server: torch, kernels, page. Build from the repository's root:
#   docker build -f deploy/edge.Dockerfile -t localhost/freshfield-edge .
# Without a GPU, add --build-arg TORCH_INDEX=... with PyTorch's CPU wheel index: the image is 3 GB smaller.
FROM docker.io/library/python:3.11-slim-bookworm AS build
# One more package index for pip, where there is one; and the index that torch alone comes from.
ARG PIP_EXTRA_INDEX_URL
ARG TORCH_INDEX
WORKDIR /src
COPY pyproject.toml README.md LICENSE ./
# torch first: its layer is large and changes only with its version.
RUN python -m venv /venv \
 && torch=$(sed -n 's/.*"\(torch==[^"]*\)".*/\1/p' pyproject.toml) \
 && /venv/bin/python -m pip install --disable-pip-version-check --no-cache-dir -q \
      ${TORCH_INDEX:+--index-url $TORCH_INDEX} "$torch"
COPY proto proto
COPY camera_node camera_node
COPY channel_emu channel_emu
COPY edge_server edge_server
COPY deploy/freshfield_up deploy/freshfield_up
COPY deploy/scenarios deploy/scenarios
RUN /venv/bin/python -m pip install --disable-pip-version-check --no-cache-dir -q '.[edge,embed]'

FROM docker.io/library/python:3.11-slim-bookworm
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
RUN python -c 'from edge_server.fields.registry import make_field; make_field("ngp", {"device": "cpu"}).warm_up()'
VOLUME /runs
EXPOSE 7000 8080
HEALTHCHECK --interval=5s --timeout=3s --start-period=120s --retries=3 \
  CMD ["python", "-m", "freshfield_up.healthy", "--serving", "127.0.0.1:7000"]
CMD ["edge-server", "--help"]
