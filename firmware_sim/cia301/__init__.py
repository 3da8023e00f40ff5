"""The CANopen slave layer (CiA 301), table-driven, on canopen's object dictionary classes.

Reading order: `dictionary` (rows), `objects` (values, access, abort codes), `communication` (the rows of
1000h..1FFFh), `nmt`, `host` (what a service needs of its node), `sdo`, `pdo_mapping` and `pdo`, `sync`, `emergency`,
`heartbeat`, `storage`, `lss`, and `node`, which puts them together. A node never blocks, has no thread and no clock.
"""
