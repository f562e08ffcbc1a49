// C++17 (and later) around @PREFIX@.h: one solver an object, no heap, no exceptions.
#ifndef @GUARD@_HPP
#define @GUARD@_HPP

#include <array>
#include <cstddef>
#include <cstdint>

#include "@PREFIX@.h"

namespace @PREFIX@ {

inline constexpr std::size_t fingers = @GUARD@_FINGERS;
inline constexpr std::size_t motors = @GUARD@_MOTORS;

using Vectors = std::array<std::array<@REAL@, 3>, fingers>;
using Configuration = std::array<@REAL@, motors>;

enum class Status {
  bad_input = @GUARD@_BAD_INPUT,
  invalid = @GUARD@_INVALID,
  running = @GUARD@_RUNNING,
  solved = @GUARD@_SOLVED,
  stalled = @GUARD@_STALLED,
  iteration_limit = @GUARD@_ITERATION_LIMIT,
};

// A few hundred kilobytes: static or on the heap, not on a small stack.
class Solver {
 public:
  Solver() noexcept { @PREFIX@_init(&solver_); }

  void set_tolerance(@REAL@ position, @REAL@ angle, int finger = -1) noexcept {
    @PREFIX@_set_tolerance(&solver_, finger, position, angle);
  }
  void set_range(std::size_t motor, @REAL@ lower, @REAL@ upper) noexcept {
    @PREFIX@_set_range(&solver_, static_cast<int>(motor), lower, upper);
  }

  Status solve(const Vectors &points, const Vectors &normals,
               const Configuration *q0 = nullptr) noexcept {
    return static_cast<Status>(
        @PREFIX@_solve(&solver_, points[0].data(), normals[0].data(), q0 ? q0->data() : nullptr));
  }
  Status begin(const Vectors &points, const Vectors &normals,
               const Configuration *q0 = nullptr) noexcept {
    return static_cast<Status>(
        @PREFIX@_begin(&solver_, points[0].data(), normals[0].data(), q0 ? q0->data() : nullptr));
  }
  Status run(std::int64_t iterations) noexcept {
    return static_cast<Status>(@PREFIX@_run(&solver_, iterations));
  }

  Configuration q() const noexcept {
    Configuration answer{};
    for (std::size_t i = 0; i < motors; ++i) answer[i] = solver_.q[i];
    return answer;
  }
  @REAL@ position_error(std::size_t finger) const noexcept { return solver_.position_error[finger]; }
  @REAL@ angle_error(std::size_t finger) const noexcept { return solver_.angle_error[finger]; }
  std::int64_t iterations() const noexcept { return solver_.iterations; }

 private:
  @PREFIX@_solver solver_;
};

}  // namespace @PREFIX@

#endif
