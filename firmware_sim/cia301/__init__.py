"""The CANopen slave layer (CiA 301), table-driven, on the object dictionary classes of canopen.

Reading order: `dictionary` (rows), `objects` (values, access, abort codes), `communication` (the
rows of 1000h to 1FFFh), `nmt`, `host` (the part of a node that its services see), `sdo`,
`pdo_mapping` and `pdo`, `sync`, `emergency`, `heartbeat`, `storage`, `lss`, and `node`, which
combines them. A node never blocks, and has neither a thread nor a clock.
"""
