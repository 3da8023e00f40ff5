module rollerrig/modbus_goburrow

go 1.21

require github.com/goburrow/modbus v0.1.0

require github.com/goburrow/serial v0.1.0 // indirect
