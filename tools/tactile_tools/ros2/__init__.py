"""ROS 2 without ROS: a bridge to rmw_zenoh, and our messages as a source package."""
