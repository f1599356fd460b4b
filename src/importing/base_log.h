// src/importing/base_log.h - the motion of a robot's flange from its log.
#pragma once
#include <string>
#include <vector>

#include "chainsplat/importing.h"

namespace chainsplat::importing {

// A serial arm from a URDF: the joints from its root to one link.
struct Arm {
  struct Joint {
    std::string name;
    bool moves = false, slides = false;  // else fixed; slides: prismatic, m, else it turns, rad
    math::Pose origin;                   // parent_from_joint
    math::Vector3 axis = math::Vector3::UnitX();
    std::string follows;                // mimic: the joint whose angle it takes,
    double factor = 1.0, offset = 0.0;  // times factor plus offset
  };
  std::string root, flange;  // links
  std::vector<Joint> joints;
  std::vector<std::string> moving() const;  // names of those with an angle of their own, from root to flange
};
// `flange` empty: the last link of the longest branch. Throws InputError, with the links that there are.
Arm read_urdf(const Path& file, const std::string& flange);
// root_from_flange; `angles` as moving() names them, rad or m.
math::Pose forward(const Arm& arm, const math::VectorX& angles);

}  // namespace chainsplat::importing
