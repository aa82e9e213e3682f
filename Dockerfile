# gaitgauge in a container.
#   docker build -t gaitgauge .                                   judging, on CPUs
#   docker build -t gaitgauge:cuda --build-arg DEVICE=cuda .      training, on NVIDIA GPUs (docker run --gpus all …)
#   … --build-arg KERNELS="sm_90"                                 its kernels compiled into the image
#   docker run --rm --user "$(id -u):$(id -g)" -v "$PWD:/work" gaitgauge …    files in $PWD belong to you, not to root
ARG PYTHON=3.12
FROM python:${PYTHON}-slim-bookworm

# for pictures without a display, and git, which runs note the commit with
RUN apt-get update \
    && apt-get install --yes --no-install-recommends git libegl1 libgl1-mesa-dri libosmesa6 \
    && rm -rf /var/lib/apt/lists/*

ENV PIP_NO_CACHE_DIR=1 PYTHONUNBUFFERED=1 WARP_CACHE_PATH=/opt/kernels

# torch first and alone: it is most of the image and changes least. The usual wheels for Linux are the CUDA ones.
ARG DEVICE=cpu
COPY constraints.txt /opt/constraints.txt
RUN torch="$(grep '^torch==' /opt/constraints.txt)" \
    && case "$DEVICE" in \
        cpu) pip install "$torch" --index-url https://download.pytorch.org/whl/cpu ;; \
        cuda) pip install "$torch" ;; \
        *) echo "DEVICE is '$DEVICE'; give cpu or cuda" >&2; exit 1 ;; \
    esac

COPY . /opt/gaitgauge
RUN pip install --constraint /opt/constraints.txt /opt/gaitgauge && rm -rf /opt/gaitgauge

# What can be compiled without a GPU; the rest is compiled at the first use.
ARG KERNELS=""
RUN mkdir -p /opt/kernels && chmod 777 /opt/kernels \
    && for arch in $KERNELS; do gaitgauge warmup --arch "$arch" || exit 1; done \
    && chmod -R a+rwX /opt/kernels

# For users that the image does not know (docker run --user): libraries ask for a home that can be written, and a name.
ENV HOME=/tmp USER=gaitgauge

# runs and results go into the folder that is mounted here
WORKDIR /work
ENTRYPOINT ["gaitgauge"]
CMD ["--help"]
