"""The CANopen slave layer (CiA 301), table-driven, on canopen's object dictionary classes.

Reading order: `dictionary` (rows), `communication` (the rows of 1000h..1FFFh), `objects` (values
and access), `abort`, `sdo` and `sdo_block`, `identifiers`, `pdo_mapping` and `pdo`, `sync`,
`emergency`, `nmt`, `heartbeat`, `lss`, `storage`, `timers`, and `node`, which puts them together. A
node never blocks, has no thread and no clock.
"""
