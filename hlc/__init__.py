"""What decides motion: recorded gait, movement primitive, inverse dynamics, limits and the controller.

Numerics only: nothing here reads a clock or knows a bus frame, except the node that joins the controller to its master.
"""
