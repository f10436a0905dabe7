# ROS 2 Jazzy with this package, for amd64 and arm64. Not run yet; test/test_house.py compares its commands with
# docs/guides/installation.md.
FROM ros:jazzy

SHELL ["/bin/bash", "-eo", "pipefail", "-c"]
ENV PIP_BREAK_SYSTEM_PACKAGES=1
WORKDIR /root/ros2_ws
COPY . src/uwb_mitigation

RUN apt-get update && rosdep update && \
    source /opt/ros/jazzy/setup.bash && \
    export PIP_CONSTRAINT=$PWD/src/uwb_mitigation/requirements/ros_constraints.txt && \
    rosdep install --from-paths src src/uwb_mitigation/msg_defs --ignore-src -y && \
    pip install --user -r src/uwb_mitigation/requirements/ros_machine.txt && \
    colcon build --base-paths src src/uwb_mitigation/msg_defs && \
    rm -rf /var/lib/apt/lists/*

RUN source install/setup.bash && \
    export PATH=$HOME/.local/bin:$PATH && \
    uwb-mitigation doctor && \
    colcon test --base-paths src src/uwb_mitigation/msg_defs --return-code-on-test-failure

CMD ["bash", "-c", "source install/setup.bash && exec ros2 launch uwb_mitigation uwb.launch.py source:=simulated"]
