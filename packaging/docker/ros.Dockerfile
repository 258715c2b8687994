# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
#
# The nodes in a workspace of ROS 2, as docs/install.md says.
#   docker build --file packaging/docker/ros.Dockerfile --tag rs_localizer:jazzy .
#   docker build --file packaging/docker/ros.Dockerfile --build-arg ROS_DISTRO=lyrical --tag rs_localizer:lyrical .
#   docker run --rm --network host rs_localizer:jazzy ros2 launch rs_localizer localizer.launch.py
ARG ROS_DISTRO=jazzy
FROM ros:${ROS_DISTRO}
ARG ROS_DISTRO
WORKDIR /workspace
COPY . src/rs_localizer
# Numba, for the build, and rosbags: pip's where Ubuntu has none (24.04), beside Ubuntu's NumPy.
RUN apt-get update \
    && rosdep update --rosdistro ${ROS_DISTRO} \
    && rosdep install --from-paths src --ignore-src --default-yes --dependency-types=exec \
    && if [ "${ROS_DISTRO}" = jazzy ]; then \
        apt-get install --yes --no-install-recommends python3-pip \
        && pip install --no-cache-dir --break-system-packages "numba>=0.63,<0.69" "rosbags>=0.11,<0.12" "numpy<2"; \
    else \
        apt-get install --yes --no-install-recommends python3-rosbags; \
    fi \
    && rm -rf /var/lib/apt/lists/*
RUN . "/opt/ros/${ROS_DISTRO}/setup.sh" && colcon build --packages-select rs_localizer
RUN printf '#!/bin/sh\n. /workspace/install/setup.sh\nexec "$@"\n' >/entrypoint && chmod +x /entrypoint
ENTRYPOINT ["/entrypoint"]
CMD ["ros2", "run", "rs_localizer", "localizer"]
