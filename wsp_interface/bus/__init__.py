"""CAN: frames, the hub of a bench and its protocols, CAN interfaces of the kernel.

Reading order:

    connection_set, frames       identifiers of CANopen; a frame and the bits that it takes
    wire                         arbitration: which frame goes first, and when
    session, codecs              the protocols of the hub; one file each: socketcand, slcan,
                                 virtualcan, cannelloni
    client, hub                  one TCP client; the bus that stamps and distributes frames
    kernel                       CAN interfaces of Linux
    plugin, buses                the hub as a python-can interface; a bus from its address
    sdo_client                   reads and writes objects of a node
"""
