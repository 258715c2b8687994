// Copyright 2026 rs_localizer contributors
// SPDX-License-Identifier: Apache-2.0
//
// A matcher for the node in C++: publishes matches, and prints the poses that come back.
// In a package of yours, with CMake: find_package(rclcpp sensor_msgs geometry_msgs REQUIRED),
// add_executable(matcher 03_node_client.cpp), ament_target_dependencies(matcher rclcpp sensor_msgs
// geometry_msgs).
#include <chrono>
#include <cmath>
#include <random>

#include <geometry_msgs/msg/pose_stamped.hpp>
#include <rclcpp/rclcpp.hpp>
#include <sensor_msgs/msg/camera_info.hpp>
#include <sensor_msgs/msg/point_cloud2.hpp>
#include <sensor_msgs/point_cloud2_iterator.hpp>

using sensor_msgs::msg::CameraInfo;
using sensor_msgs::msg::PointCloud2;

int main(int argc, char ** argv)
{
  rclcpp::init(argc, argv);
  auto node = rclcpp::Node::make_shared("matcher");
  auto clouds = node->create_publisher<PointCloud2>("correspondences", rclcpp::SensorDataQoS());
  auto infos = node->create_publisher<CameraInfo>("camera_info", rclcpp::QoS(1).transient_local());
  auto poses = node->create_subscription<geometry_msgs::msg::PoseStamped>(
    "rs_localizer/pose", 10, [&](const geometry_msgs::msg::PoseStamped & it) {
      const auto & p = it.pose.position;
      RCLCPP_INFO(node->get_logger(), "%.3f %.3f %.3f", p.x, p.y, p.z);
    });

  CameraInfo info;  // once: the localizer keeps it
  info.width = 640;
  info.height = 480;
  info.distortion_model = "plumb_bob";
  info.d.assign(5, 0.0);
  info.k = {500.0, 0.0, 319.5, 0.0, 500.0, 239.5, 0.0, 0.0, 1.0};
  info.header.frame_id = "camera";
  info.header.stamp = node->now();
  infos->publish(info);

  auto timer = node->create_wall_timer(std::chrono::milliseconds(33), [&] {
      // Here the matches of yours go: this camera stands still before a scene.
      PointCloud2 cloud;
      cloud.header.frame_id = "map";
      cloud.header.stamp = node->now();  // of the image
      cloud.height = 1;
      sensor_msgs::PointCloud2Modifier modifier(cloud);
      const auto f = sensor_msgs::msg::PointField::FLOAT32;
      modifier.setPointCloud2Fields(5, "x", 1, f, "y", 1, f, "z", 1, f, "u", 1, f, "v", 1, f);
      modifier.resize(150);
      sensor_msgs::PointCloud2Iterator<float> row(cloud, "x");
      std::mt19937 random(0);
      std::uniform_real_distribution<float> side(-1.2f, 1.2f), ahead(3.0f, 6.0f);
      for (int k = 0; k < 150; ++k, ++row) {
        row[0] = side(random);
        row[1] = 0.75f * side(random);
        row[2] = ahead(random);
        row[3] = 500.0f * row[0] / row[2] + 319.5f;  // u, raw pixels: x y z u v follow each other
        row[4] = 500.0f * row[1] / row[2] + 239.5f;
      }
      clouds->publish(cloud);
    });
  rclcpp::spin(node);
  rclcpp::shutdown();
}
