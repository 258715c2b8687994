// What the authors' C++ (github.com/CenekAlbl/RnP, commit 9016081) makes of samples; none of its
// code is here. Lines of 30 numbers come in, six X Y Z and six x y whose row time is x; lines of 12
// numbers go out, v C w t: R6PIter after 1, 2 and 5 iterations, then "r6p" and the solutions of
// R6P2Lin, then "end". Into a checkout, beside c++:
//   g++ -O2 -I EIGEN -I c++ authors.cpp c++/iterative.cpp c++/r6p_iter.cpp c++/r6p_2lin.cpp \
//       c++/r7pf.cpp c++/r7pfr.cpp c++/rnp.cpp c++/utils.cpp c++/sturm.cpp
#include <cstdio>
#include <iostream>

#include "rnp.h"

static void print(const RSDoublelinCameraPose& pose) {
  for (const Eigen::Vector3d& part : {pose.v, pose.C, pose.w, pose.t})
    for (int k = 0; k < 3; k++) std::printf("%.17g ", part(k));
  std::printf("\n");
}

int main() {
  Eigen::MatrixXd X(3, 6), u(2, 6);
  while (true) {
    for (int i = 0; i < 18; i++) std::cin >> X(i % 3, i / 3);
    for (int i = 0; i < 12; i++) std::cin >> u(i % 2, i / 2);
    if (!std::cin) return 0;
    for (int iterations : {1, 2, 5}) {
      RSDoublelinCameraPose pose;
      iterativeRnP<RSDoublelinCameraPose, R6PIter>(X, u, Eigen::Vector3d::Zero(), 6, 0.0, 0,
                                                   iterations, pose);
      print(pose);
    }
    std::printf("r6p\n");
    RSDoublelinCameraPoseVector all;
    R6P2Lin(X, u, 0, 0.0, &all);
    for (const auto& pose : all) print(pose);
    std::printf("end\n");
  }
}
