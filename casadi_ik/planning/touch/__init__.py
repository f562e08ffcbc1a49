"""From an object's surface to grasps that an arm-hand can make."""
