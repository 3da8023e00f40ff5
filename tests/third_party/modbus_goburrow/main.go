// goburrow/modbus, whose unit is 0 unless a program chooses another: reads the measured speeds.
//
//	go run . 127.0.0.1:5020
//
// Prints the answers for the units 0, 255 and 1 as JSON.
package main

import (
	"encoding/json"
	"fmt"
	"os"

	"github.com/goburrow/modbus"
)

func main() {
	handler := modbus.NewTCPClientHandler(os.Args[1])
	if err := handler.Connect(); err != nil {
		fmt.Fprintln(os.Stderr, err)
		os.Exit(1)
	}
	defer handler.Close()
	client := modbus.NewClient(handler)
	answers := map[string]string{}
	for _, unit := range []byte{0, 255, 1} {
		handler.SlaveId = unit
		data, err := client.ReadHoldingRegisters(208, 4)
		if err != nil {
			fmt.Fprintln(os.Stderr, unit, err)
			os.Exit(1)
		}
		answers[fmt.Sprint(unit)] = fmt.Sprintf("%x", data)
	}
	if err := json.NewEncoder(os.Stdout).Encode(answers); err != nil {
		os.Exit(1)
	}
}
