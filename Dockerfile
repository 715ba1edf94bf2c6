# docker build -t tpm-gym . && docker run --rm -v "$PWD/runs:/data/runs" tpm-gym train --env TPMReach-v0 --steps 5000
FROM python:3.11-slim

# MuJoCo draws with Mesa's software OpenGL where there is no GPU.
RUN apt-get update \
    && apt-get install --yes --no-install-recommends libegl1 libgl1 libosmesa6 \
    && rm -rf /var/lib/apt/lists/*
ENV MUJOCO_GL=egl OMP_NUM_THREADS=1

COPY . /src
RUN pip install --no-cache-dir --extra-index-url https://download.pytorch.org/whl/cpu \
    -c /src/constraints.txt "/src[train,mujoco]"

WORKDIR /data
ENTRYPOINT ["tpm-gym"]
CMD ["--help"]
