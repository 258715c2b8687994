"""Start the node of one camera.

ros2 launch rs_localizer localizer.launch.py namespace:=front params_file:=front.yaml
ros2 launch rs_localizer localizer.launch.py readout_time:=0.02 base_frame:=base_link
"""

from launch.substitutions import LaunchConfiguration

from launch import LaunchContext, LaunchDescription
from rs_localizer.ros.launching import argument, common_arguments, localizer, starting, views

# Input topics, which the drivers of cameras and the trackers of features name as they like.
TOPICS = {
    "correspondences": "points of the map and their pixels (sensor_msgs/PointCloud2)",
    "keypoints": "pixels with ids or descriptors, to be matched (sensor_msgs/PointCloud2)",
    "detections": "tags of a detector (apriltag_msgs/AprilTagDetectionArray)",
    "map_points": "the map for keypoints, latched (sensor_msgs/PointCloud2)",
    "camera_info": "the camera's calibration (sensor_msgs/CameraInfo)",
    "imu": "the IMU beside the camera (sensor_msgs/Imu)",
}


def generate_launch_description() -> LaunchDescription:
    """A node with its settings, its namespace and the topics of its camera as arguments."""
    topics = [argument(name, name, f"topic: {text}") for name, text in TOPICS.items()]
    return LaunchDescription(starting([*common_arguments(), *topics], _nodes))


def _nodes(context: LaunchContext) -> list:
    chosen = context.launch_configurations
    remappings = [(name, LaunchConfiguration(name)) for name in TOPICS]
    return [*views(chosen), localizer(chosen, remappings)]
