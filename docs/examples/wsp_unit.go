// A WSP unit of one's own in Go, standard library only: socketcand's ASCII over TCP.
//
//	rollerrig run velim_a1 --wsp external &  go run wsp_unit.go [host:port [bus]]
//
// After each SYNC (080h) node 16 sends four axle speeds (190h, I16, 0.01 rad/s); the answer is one
// byte for node 17 (211h): bit 2j holds, bit 2j+1 vents axle j+1. Every fifth SYNC brings a
// heartbeat (720h) before the answer, because in lockstep pacing time-outs count simulated time;
// the wall clock counts only while no SYNC comes.
package main

import (
	"bufio"
	"encoding/binary"
	"encoding/hex"
	"errors"
	"fmt"
	"io"
	"log"
	"net"
	"os"
	"strings"
	"time"
)

const (
	radiusM, cycleS         = 0.445, 0.01
	fill, hold, vent   byte = 0, 1, 3
	sync, speeds            = "080", "190"
	magnets, heartbeat      = "211", "720"
	quiet                   = 100 * time.Millisecond
)

// unit is the memory of a simple slip and deceleration protection.
type unit struct {
	reference float64
	lagged    [4]float64
	cycles    int
	magnets   byte
}

// protect returns the byte of magnets for four axle speeds in m/s.
func (u *unit) protect(v [4]float64) byte {
	if u.cycles == 0 {
		u.lagged = v
	}
	u.reference = max(v[0], v[1], v[2], v[3], u.reference-1.6*cycleS)
	// all wheels may slide at once: axle 4 then runs free now and then and shows the vehicle's speed
	u.cycles++
	free := u.magnets != 0 && u.cycles%300 < 120
	u.magnets = 0
	for j := range v {
		rate := (v[j] - u.lagged[j]) / (4 * cycleS)
		u.lagged[j] += rate * cycleS
		sliding, valve := u.reference-v[j], fill
		switch {
		case u.reference < 1:
		case free && j == 3:
			valve = vent
		case sliding < 0.5+0.05*u.reference || rate > 1:
		case rate < -1.8 || sliding > 0.15*u.reference+1:
			valve = vent
		default:
			valve = hold
		}
		u.magnets |= valve << (2 * j)
	}
	return u.magnets
}

// read returns the words of the next message, "< frame 190 1.234567 0102 >" without its brackets.
func read(r *bufio.Reader) ([]string, error) {
	text, err := r.ReadString('>')
	return strings.Fields(strings.Trim(text, "<> \r\n")), err
}

// join opens the bus in raw mode; each answer is awaited before the next command.
func join(conn net.Conn, r *bufio.Reader, bus string) error {
	for _, command := range []string{"", "< open " + bus + " >", "< rawmode >"} {
		if _, err := io.WriteString(conn, command); err != nil {
			return err
		}
		words, err := read(r)
		if err != nil || len(words) != 1 || words[0] != "hi" && words[0] != "ok" {
			return fmt.Errorf("%q was answered by %q (%v)", command, words, err)
		}
	}
	return nil
}

// serve answers every SYNC until the rig closes the bus, which it returns as io.EOF.
func serve(conn net.Conn, r *bufio.Reader) error {
	send := func(id string, data byte) {
		// a failed write shows at the next read
		fmt.Fprintf(conn, "< send %s 1 %02x >", id, data)
	}
	frames, failed := make(chan []string, 64), make(chan error, 1)
	go func() {
		for {
			words, err := read(r)
			if err != nil {
				failed <- err
				return
			}
			frames <- words
		}
	}()
	send(heartbeat, 0) // boot-up
	send(heartbeat, 5) // operational
	silence := time.NewTimer(quiet)
	var u unit
	for count, awaiting := 0, false; ; {
		select {
		case err := <-failed:
			return err
		case <-silence.C:
			send(heartbeat, 5)
			silence.Reset(quiet)
		case f := <-frames:
			switch {
			case len(f) < 3 || f[0] != "frame":
			case f[1] == sync:
				silence.Reset(quiet)
				count++
				if awaiting = true; count%5 == 0 {
					send(heartbeat, 5)
				}
			case f[1] == speeds && awaiting && len(f) == 4:
				raw, err := hex.DecodeString(f[3])
				if err != nil || len(raw) != 8 {
					continue
				}
				var v [4]float64
				for j := range v {
					counts := int16(binary.LittleEndian.Uint16(raw[2*j:]))
					v[j] = float64(counts) * 0.01 * radiusM
				}
				awaiting = false
				send(magnets, u.protect(v))
			}
		}
	}
}

func main() {
	address, bus := "127.0.0.1:29536", "rig0"
	if len(os.Args) > 1 {
		address = os.Args[1]
	}
	if len(os.Args) > 2 {
		bus = os.Args[2]
	}
	conn, err := net.Dial("tcp", address) // Go sets TCP_NODELAY itself
	for tries := 0; err != nil; tries++ { // the rig may still be starting
		if tries == 300 {
			log.Fatal(err)
		}
		time.Sleep(200 * time.Millisecond)
		conn, err = net.Dial("tcp", address)
	}
	defer conn.Close()
	r := bufio.NewReader(conn)
	if err := join(conn, r, bus); err != nil {
		log.Fatal(err)
	}
	if err := serve(conn, r); errors.Is(err, io.EOF) {
		log.Print("the rig has closed the bus")
	} else {
		log.Printf("the bus is lost: %v", err)
	}
}
