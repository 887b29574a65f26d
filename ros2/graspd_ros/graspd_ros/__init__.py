"""A ROS 2 node that detects grasps with graspd. `moveit` converts its results for MoveIt."""
