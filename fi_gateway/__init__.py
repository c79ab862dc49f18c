"""What breaks frames: faults, events, effects and triggers, and the gateway that applies them between two CAN buses.

Terms after Fabarisov et al., "Model-based fault injection" (FIBlock), ESREL 2020: a fault says what comes out, an event
when it starts, an effect how long it lasts, a trigger which other injector starts it.
"""
