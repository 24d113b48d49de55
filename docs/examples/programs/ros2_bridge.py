"""Lets a filter that runs as nodes of ROS 2 compete, such as robot_localization's: a program that is a node itself.

For every track i it publishes the initial estimate on ``track_i/initial`` and each measurement on ``track_i/position``,
both geometry_msgs/PoseWithCovarianceStamped, and waits for nav_msgs/Odometry of the same time on ``track_i/estimate``.
A scan that missed the target is a measurement of infinite covariance. Velocities are in the frame of the track.

filtergym evaluate filtergym/ManeuveringTarget-v0 --episodes 8 --policy "exec:/usr/bin/python3 ros2_bridge.py" --time-limit 60
"""

from __future__ import annotations

import math
from typing import Any, Callable

import rclpy
from client import serve
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from rclpy.node import Node
from rclpy.time import Time

Estimate = tuple[list[float], list[list[float]]]

rclpy.init()
node: Node = rclpy.create_node("filtergym_bridge")
count = 0


def pose(seconds: float, position: list[float], covariance: list[list[float]]) -> PoseWithCovarianceStamped:
    """Return a message about a position in the plane."""
    message = PoseWithCovarianceStamped()
    message.header.frame_id = "odom"
    message.header.stamp = Time(seconds=seconds).to_msg()
    message.pose.pose.position.x, message.pose.pose.position.y = position
    for i in range(2):
        for j in range(2):
            message.pose.covariance[6 * i + j] = covariance[i][j]
    return message


def read(message: Odometry) -> Estimate:
    """Return mean and covariance of x, y, vx, vy; a message holds no covariance of position and velocity."""
    position, velocity = message.pose.pose.position, message.twist.twist.linear
    covariance = [[0.0] * 4 for _ in range(4)]
    for i in range(2):
        for j in range(2):
            covariance[i][j] = message.pose.covariance[6 * i + j]
            covariance[2 + i][2 + j] = message.twist.covariance[6 * i + j]
    return [position.x, position.y, velocity.x, velocity.y], covariance


def begin(hello: dict[str, Any], initial: dict[str, Any]) -> Callable[[dict[str, Any]], Estimate]:
    """Begin a track."""
    global count
    name, count = f"track_{count}", count + 1
    seconds, found = 0.0, dict[int, Odometry]()

    def receive(message: Odometry) -> None:
        found[Time.from_msg(message.header.stamp).nanoseconds] = message

    node.create_subscription(Odometry, f"{name}/estimate", receive, 10)
    positions = node.create_publisher(PoseWithCovarianceStamped, f"{name}/position", 10)
    starts = node.create_publisher(PoseWithCovarianceStamped, f"{name}/initial", 10)
    starts.publish(pose(0.0, initial["mean"][:2], initial["covariance"]))

    def update(measurement: dict[str, Any]) -> Estimate:
        """Publish a measurement, and wait for the estimate of its time."""
        nonlocal seconds
        seconds += measurement["interval"]
        seen = bool(measurement["available"])
        first, second = measurement["variance"] if seen else (math.inf, math.inf)
        position = measurement["position"] if seen else [0.0, 0.0]
        positions.publish(pose(seconds, position, [[first, 0.0], [0.0, second]]))
        stamp = Time(seconds=seconds).nanoseconds
        while stamp not in found:
            rclpy.spin_once(node)
        answer = read(found[stamp])
        found.clear()
        return answer

    return update


serve(begin)
