"""ROS 1 bags, ROS 2 bags and MCAP files, read and written without ROS.

``containers`` know where messages lie (``bag1``, ``mcap``, ``sqlite``, ``folder``), ``messages`` what one says, and
``log`` which sensor each topic is.
"""
