from typing import Any

# ROS 2 may not be installed where the types are checked, and its wheels have none.
def __getattr__(name: str) -> Any: ...
