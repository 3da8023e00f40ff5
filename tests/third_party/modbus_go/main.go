// A Modbus client that knows nothing of rollerrig but its map: reads, writes, walks a drive.
//
//	go run . tcp://127.0.0.1:5020
//	go run . rtu:///dev/pts/3
//	go run . tcp+tls://127.0.0.1:5020 client.pem client.key authority.pem
//
// Prints one JSON object and leaves with status 1 at the first thing that is not as the map says.
package main

import (
	"crypto/tls"
	"encoding/json"
	"fmt"
	"os"
	"time"

	"github.com/simonvetter/modbus"
)

func must(err error, what string) {
	if err != nil {
		fmt.Fprintf(os.Stderr, "%s: %v\n", what, err)
		os.Exit(1)
	}
}

func refused(err error, wanted error, what string) {
	if err != wanted {
		fmt.Fprintf(os.Stderr, "%s: %v, not %v\n", what, err, wanted)
		os.Exit(1)
	}
}

func configuration() *modbus.ClientConfiguration {
	given := &modbus.ClientConfiguration{URL: os.Args[1], Timeout: 2 * time.Second, Speed: 19200,
		Parity: modbus.PARITY_EVEN, StopBits: 1}
	if len(os.Args) > 4 {
		pair, err := tls.LoadX509KeyPair(os.Args[2], os.Args[3])
		must(err, "client certificate")
		authority, err := modbus.LoadCertPool(os.Args[4])
		must(err, "authority")
		given.TLSClientCert, given.TLSRootCAs = &pair, authority
	}
	return given
}

// walk takes the drive behind the present unit to OPERATION ENABLED and gives its last statusword.
func walk(client *modbus.ModbusClient) uint16 {
	var status uint16
	for _, step := range []struct{ word, state uint16 }{{6, 0x21}, {7, 0x23}, {15, 0x27}} {
		must(client.WriteRegister(0, step.word), "controlword")
		told, err := client.ReadRegister(100, modbus.INPUT_REGISTER)
		must(err, "statusword")
		if told&0x6F != step.state {
			fmt.Fprintf(os.Stderr, "controlword %d: statusword %04X\n", step.word, told)
			os.Exit(1)
		}
		status = told
	}
	return status
}

func main() {
	client, err := modbus.NewClient(configuration())
	must(err, "configuration")
	must(client.Open(), "connection")
	defer client.Close()

	must(client.SetUnitId(1), "unit")
	speeds, err := client.ReadRegisters(208, 4, modbus.HOLDING_REGISTER)
	must(err, "wheel speeds")
	pulses, err := client.ReadUint32(260, modbus.INPUT_REGISTER)
	must(err, "pulse counter")
	must(client.WriteRegisters(1, []uint16{2500, 0xFFFF}), "set-points")
	must(client.WriteCoil(0, true), "run")
	bits, err := client.ReadDiscreteInputs(0, 8)
	must(err, "bits")
	_, err = client.ReadRegisters(9000, 1, modbus.HOLDING_REGISTER)
	refused(err, modbus.ErrIllegalDataAddress, "a register that is not there")
	refused(client.WriteRegister(1, 60000), modbus.ErrIllegalDataValue, "a speed out of range")

	must(client.SetUnitId(12), "unit")
	status := walk(client)
	must(client.WriteUint32(2, 123456), "target velocity")
	target, err := client.ReadUint32(2, modbus.HOLDING_REGISTER)
	must(err, "target velocity")

	must(json.NewEncoder(os.Stdout).Encode(map[string]any{
		"speeds": speeds, "pulses": pulses, "bits": bits, "status": status, "target": target,
	}), "output")
}
