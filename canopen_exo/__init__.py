"""What goes on the wire: CAN frames, the emulated bus, and the CANopen state machines (CiA 301, CiA 402)."""
