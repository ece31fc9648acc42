"""The node: targets, joint states and measured tips in, commands and status out.

Subscribes ``target`` (geometry_msgs/PoseStamped), ``joint_states`` (sensor_msgs/JointState, once,
for the start) and ``tip`` (geometry_msgs/PointStamped, optional, measured). Publishes ``command``
(sensor_msgs/JointState, in the names and the unit of the log) and ``status`` (std_msgs/String).
"""

import rclpy
from geometry_msgs.msg import PointStamped, PoseStamped
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_msgs.msg import String

from hybridkin_tracker.follower import Follower


class TrackerNode(Node):
    """Publishes a command every period."""

    def __init__(self):
        super().__init__("hybridkin_tracker")
        defaults = {
            "model": "",
            "period": 0.01,
            "dq_max": 0.0,
            "tolerance": 1e-3,
            "frame": "base",
        }
        value = {}
        for name, default in defaults.items():
            value[name] = self.declare_parameter(name, default).value
        self._frame = value["frame"]
        self._follower = Follower(
            value["model"], value["period"], value["dq_max"], value["tolerance"]
        )
        self._command = self.create_publisher(JointState, "command", 10)
        self._status = self.create_publisher(String, "status", 10)
        self.create_subscription(PoseStamped, "target", self._targeted, 10)
        self.create_subscription(JointState, "joint_states", self._started, 10)
        self.create_subscription(PointStamped, "tip", self._measured, 10)
        self.create_timer(value["period"], self._tick)

    def _targeted(self, message):
        if message.header.frame_id not in ("", self._frame):
            self.get_logger().warning(
                f"target in {message.header.frame_id!r} ignored; it must be in {self._frame!r}"
            )
            return
        place = message.pose.position
        self._follower.target_at([place.x, place.y, place.z])

    def _started(self, message):
        self._follower.actuators_at(message.name, message.position)

    def _measured(self, message):
        place = message.point
        self._follower.measured_at([place.x, place.y, place.z])

    def _tick(self):
        command = self._follower.step()
        if command is None:
            return
        message = JointState()
        message.header.stamp = self.get_clock().now().to_msg()
        message.name = self._follower.names
        message.position = command.tolist()
        self._command.publish(message)
        name, error = self._follower.status
        self._status.publish(String(data=f"{name}, error {1e3 * error:.2f} mm"))


def main():
    """Run the node until Ctrl-C."""
    rclpy.init()
    node = TrackerNode()
    try:
        rclpy.spin(node)
    except KeyboardInterrupt:
        pass
    finally:
        node.destroy_node()
