"""Rarely needed file formats, receivers and observers, which slrig finds by entry points (`slrig.plugins`).

e57: clouds for surveyors. ros: a scan as a ROS 2 bag. ros_node: the service as a ROS 2 node. mqtt: notices to a broker.
telemetry: jobs as OpenTelemetry traces. Each needs the extra of its name (`ros_node`: ROS 2 itself).
"""
