# A robot's link without the laboratory: docs/how-to/radios.md, "In a container".
FROM ubuntu:24.04 AS base
# Those of the Debian package; DRIVERS are Debian packages for a radio, such as "soapysdr-module-hackrf".
ARG DRIVERS=""
ENV DEBIAN_FRONTEND=noninteractive
RUN apt-get update \
    && apt-get install --yes --no-install-recommends \
        gnuradio python3-click python3-cryptography python3-numpy python3-packaging python3-serial python3-yaml ${DRIVERS} \
    && rm -rf /var/lib/apt/lists/*

FROM base AS build
# Further parts of gr-ros2, such as "zenoh,video,foxglove".
ARG EXTRAS="zenoh"
RUN apt-get update && apt-get install --yes --no-install-recommends build-essential python3-dev python3-venv
WORKDIR /src
COPY setup.py pyproject.toml package.xml README.md LICENSE ./
COPY launch launch
COPY resource resource
COPY gr_ros2 gr_ros2
RUN python3 -m venv --system-site-packages /opt/gr-ros2 \
    && /opt/gr-ros2/bin/pip install --no-cache-dir --no-compile ".[${EXTRAS}]"

FROM base
COPY --from=build /opt/gr-ros2 /opt/gr-ros2
# The first user of most machines has number 1000 too, and so may own the key file.
RUN userdel --remove ubuntu \
    && useradd --uid 1000 --groups audio,dialout,plugdev --home-dir /var/lib/gr-ros2 --create-home gr-ros2
ENV PATH=/opt/gr-ros2/bin:$PATH
USER gr-ros2
WORKDIR /var/lib/gr-ros2
VOLUME /var/lib/gr-ros2
ENTRYPOINT ["gr-ros2"]
CMD ["link", "/etc/gr-ros2/robot.yaml"]
