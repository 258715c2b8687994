// Copyright 2026 rs_localizer contributors
// SPDX-License-Identifier: Apache-2.0
//
// A condition for nav2's behaviour tree (Jazzy): whether the robot knows where it is.
// In a package of yours, with CMake: find_package(behaviortree_cpp geometry_msgs rclcpp tf2_ros
// REQUIRED), add_library(nav2_is_localized SHARED nav2_is_localized.cpp),
// ament_target_dependencies(nav2_is_localized behaviortree_cpp geometry_msgs rclcpp tf2_ros).
// Then plugin_lib_names: [nav2_is_localized] of bt_navigator loads it.
#include <algorithm>
#include <chrono>
#include <cmath>
#include <memory>
#include <string>

#include <behaviortree_cpp/bt_factory.h>
#include <geometry_msgs/msg/pose_with_covariance_stamped.hpp>
#include <rclcpp/rclcpp.hpp>
#include <tf2_ros/buffer.h>

class IsLocalized : public BT::ConditionNode
{
public:
  using Pose = geometry_msgs::msg::PoseWithCovarianceStamped;

  IsLocalized(const std::string & name, const BT::NodeConfig & config)
  : BT::ConditionNode(name, config),
    node_(config.blackboard->get<rclcpp::Node::SharedPtr>("node")),
    tf_(config.blackboard->get<std::shared_ptr<tf2_ros::Buffer>>("tf_buffer"))
  {
    group_ = node_->create_callback_group(rclcpp::CallbackGroupType::MutuallyExclusive, false);
    executor_.add_callback_group(group_, node_->get_node_base_interface());
    rclcpp::SubscriptionOptions options;
    options.callback_group = group_;
    subscription_ = node_->create_subscription<Pose>(
      getInput<std::string>("topic").value(), rclcpp::QoS(1),
      [this](Pose::ConstSharedPtr pose) {map_to_odom_ = pose;}, options);
    executor_.spin_some(std::chrono::nanoseconds(1));  // Jazzy's first spin takes no message
  }

  static BT::PortsList providedPorts()
  {
    return {
      BT::InputPort<std::string>("topic", "/rs_localizer/map_to_odom", "of rs_localizer"),
      BT::InputPort<std::string>("base_frame", "base_link", "the robot"),
      BT::InputPort<double>("max_deviation", 0.3, "largest standard deviation of its place, m"),
      BT::InputPort<double>("max_age", 1.0, "s after which nothing is known any more"),
    };
  }

  BT::NodeStatus tick() override
  {
    executor_.spin_some();
    const double most = getInput<double>("max_deviation").value();
    return deviation() <= most ? BT::NodeStatus::SUCCESS : BT::NodeStatus::FAILURE;
  }

private:
  // Standard deviation of the robot's x and y in m; infinite if nobody knows.
  double deviation()
  {
    if (!map_to_odom_) {
      return INFINITY;
    }
    const rclcpp::Time stamp(map_to_odom_->header.stamp, node_->now().get_clock_type());
    if ((node_->now() - stamp).seconds() > getInput<double>("max_age").value()) {
      return INFINITY;
    }
    double x, y;  // from the origin of odometry, whose pose the message is, to the robot
    try {
      const auto robot = tf_->lookupTransform(
        map_to_odom_->header.frame_id, getInput<std::string>("base_frame").value(),
        tf2::TimePointZero);
      x = robot.transform.translation.x - map_to_odom_->pose.pose.position.x;
      y = robot.transform.translation.y - map_to_odom_->pose.pose.position.y;
    } catch (const tf2::TransformException &) {
      return INFINITY;
    }
    // A heading that is off moves the robot about that origin. Rows are x y z roll pitch yaw.
    const auto & c = map_to_odom_->pose.covariance;
    const double along_x = c[0] - 2.0 * y * c[5] + y * y * c[35];
    const double along_y = c[7] + 2.0 * x * c[11] + x * x * c[35];
    return std::sqrt(std::max(along_x + along_y, 0.0));
  }

  rclcpp::Node::SharedPtr node_;
  std::shared_ptr<tf2_ros::Buffer> tf_;
  rclcpp::CallbackGroup::SharedPtr group_;
  rclcpp::executors::SingleThreadedExecutor executor_;
  rclcpp::Subscription<Pose>::SharedPtr subscription_;
  Pose::ConstSharedPtr map_to_odom_;
};

BT_REGISTER_NODES(factory)
{
  factory.registerNodeType<IsLocalized>("IsLocalized");
}
