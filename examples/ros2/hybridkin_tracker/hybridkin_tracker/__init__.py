"""A ROS 2 node that steers the tip of a soft robot with a fitted hybridkin model."""
