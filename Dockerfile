# docker build -t jaxil .                      CPU
# docker build -t jaxil --build-arg EXTRA=gpu .    CUDA 12; run with --gpus=all
# docker run -v "$PWD/runs:/runs" jaxil train --config=tiny:pdac,cartpole_swingup --workdir=/runs/x
FROM python:3.11-slim-bookworm
ARG EXTRA=
# OpenGL on NVIDIA's GPUs needs more than the default "compute,utility".
ENV NVIDIA_DRIVER_CAPABILITIES=all MUJOCO_GL=egl PATH=/opt/jaxil/.venv/bin:$PATH
WORKDIR /opt/jaxil
COPY . .
RUN bash -c 'source launch/setup.sh && set_up "$EXTRA"' && rm -rf /var/lib/apt/lists/*
ENTRYPOINT ["jaxil"]
