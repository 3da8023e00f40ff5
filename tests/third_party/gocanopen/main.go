// gocanopen as the master of the rig, and its WSP unit (node 32): walks the drives to OPERATION
// ENABLED, turns a roller, reads speeds by PDO and drives the valves until the train stands.
// usage: master HOST PORT EDS_FOLDER; the bus is the hub's virtualcan port
package main

import (
	"encoding/json"
	"fmt"
	"io"
	"log/slog"
	"math"
	"os"
	"path/filepath"
	"time"

	canopen "github.com/samsamfire/gocanopen"
	"github.com/samsamfire/gocanopen/pkg/network"
	"github.com/samsamfire/gocanopen/pkg/nmt"
	"github.com/samsamfire/gocanopen/pkg/node"
)

const (
	speedUnit, brakeIO, unit = 16, 17, 32
	cycle                    = 10 * time.Millisecond
	csv                      = 9
	// the rig's data sheet: rollers, wheels, vehicle
	rollerM, wheelM, massKg, inertiaKgm2, ratedNm = 1.0, 0.445, 43000.0, 1200.0, 15000.0
	speedUp, turnCycles, rollingMrad              = 1.05, 60, 4000.0
)

type told struct {
	Enabled    []int   `json:"enabled"`
	Turned     float64 `json:"turned"`
	Cycles     int     `json:"cycles"`
	Vents      int     `json:"vents"`
	SpeedsRead int     `json:"speeds_read"`
	Stopped    bool    `json:"stopped"`
}

type master struct {
	net     network.Network
	nodes   map[int]*node.RemoteNode
	speed   float64
	turning int
	before  time.Time
	told    told
}

func check(err error, what string) {
	if err != nil {
		fmt.Fprintln(os.Stderr, what, err)
		os.Exit(1)
	}
}

// what a PDO has brought into the local image of a node
func (m *master) i32(id int, index uint16) float64 {
	value, _ := m.nodes[id].GetOD().Index(index).Uint32(0)
	return float64(int32(value))
}

func (m *master) i16(id int, index uint16, sub uint8) float64 {
	value, _ := m.nodes[id].GetOD().Index(index).Uint16(sub)
	return float64(int16(value))
}

// a node's receive PDOs carry what stands in its local image
func (m *master) command(id int, word uint16) {
	check(m.nodes[id].GetOD().Index(0x6040).PutUint16(0, word, true), "controlword")
}

func (m *master) enable(id int) {
	check(m.nodes[id].GetOD().Index(0x6060).PutUint8(0, csv, true), "mode")
	for _, step := range []struct{ word, wanted uint16 }{{6, 0x21}, {7, 0x23}, {15, 0x27}} {
		m.command(id, step.word)
		deadline := time.Now().Add(3 * time.Second)
		for {
			word, err := m.net.ReadUint16(uint8(id), 0x6041, 0)
			if err == nil && word&0x6f == step.wanted {
				break
			}
			if time.Now().After(deadline) {
				check(fmt.Errorf("%04X %v", word, err), fmt.Sprintf("drive %d after %d:", id, step.word))
			}
			time.Sleep(5 * time.Millisecond)
		}
	}
	m.told.Enabled = append(m.told.Enabled, id)
}

// inertia of the vehicle at the rollers, which the master simulates from the drives' torques
func (m *master) simulate() {
	now := time.Now()
	elapsed := now.Sub(m.before).Seconds()
	m.before = now
	sum, pressed := 0.0, false
	for axle := uint8(1); axle <= 4; axle++ {
		sum += m.i16(speedUnit, 0x6030, axle) * 0.01 * wheelM / 4
		pressed = pressed || m.i16(brakeIO, 0x6401, axle) >= 100
	}
	if !pressed {
		// once the rollers are held they tell what they were told: the speed of before counts
		if m.turning == 0 {
			m.speed = sum
		}
		return
	}
	torque := 0.0
	for id := 1; id <= 4; id++ {
		torque += m.i16(id, 0x6077, 0) * 1e-3 * ratedNm
	}
	m.speed = math.Max(0, m.speed-torque/rollerM/(massKg-4*inertiaKgm2/(rollerM*rollerM))*elapsed)
}

// a simple slide protection: vent a wheel that slides much, hold one that slides
func (m *master) protect() {
	bits := uint8(0)
	for axle := uint8(1); axle <= 4; axle++ {
		sliding := m.speed - m.i16(speedUnit, 0x6030, axle)*0.01*wheelM
		if m.speed > 1 && sliding > 0.5+0.15*m.speed {
			bits |= 3 << (2 * (axle - 1))
			m.told.Vents++
		} else if m.speed > 1 && sliding > 0.3+0.05*m.speed {
			bits |= 1 << (2 * (axle - 1))
		}
	}
	// its event-driven PDOs go out on a change only; the valves want theirs in every cycle
	frame := canopen.NewFrame(0x200+brakeIO, 0, 1)
	frame.Data[0] = bits
	_ = m.net.Send(frame)
}

// one bus cycle; false when the bus has ended
func (m *master) step() bool {
	m.told.Cycles++
	m.simulate()
	m.protect()
	factor := 1.0
	// the rig may have waited for its unit: it rolls when its rollers' angles grow
	rolls := m.i32(2, 0x6064) > rollingMrad
	if rolls && len(m.told.Enabled) == 4 && m.turning < turnCycles {
		m.turning++
		factor = speedUp
		if second := m.i32(2, 0x606c); second > 0 {
			m.told.Turned = math.Max(m.told.Turned, m.i32(1, 0x606c)/second)
		}
	}
	still := true
	for id := 1; id <= 4; id++ {
		target := m.speed / rollerM * 1e4
		if id == 1 {
			target *= factor
		}
		check(m.nodes[id].GetOD().Index(0x60ff).PutUint32(0, uint32(int32(target)), true), "target")
		speed := m.i16(speedUnit, 0x6030, uint8(id))
		if speed != 0 {
			m.told.SpeedsRead++
		}
		still = still && speed == 0 && m.i32(id, 0x606c) == 0
	}
	m.told.Stopped = m.told.SpeedsRead > 200 && still
	if m.told.Cycles%5 == 0 {
		beat := canopen.NewFrame(0x700+unit, 0, 1)
		beat.Data[0] = 5
		if m.net.Send(beat) != nil {
			return false
		}
	}
	sync := canopen.NewFrame(0x80, 0, 0)
	if m.net.Send(sync) != nil {
		return false
	}
	// the bus gives nobody their own frames back, and synchronous PDOs wait for this one
	m.net.BusManager.Handle(sync)
	return true
}

func main() {
	host, port, folder := os.Args[1], os.Args[2], os.Args[3]
	quiet := slog.New(slog.NewTextHandler(io.Discard, nil))
	slog.SetDefault(quiet)
	m := &master{net: network.NewNetwork(nil), nodes: map[int]*node.RemoteNode{}}
	m.net.SetLogger(quiet)
	check(m.net.Connect("virtualcan", host+":"+port, 500000), "connect")
	for _, id := range []int{1, 2, 3, 4, speedUnit, brakeIO} {
		found, _ := filepath.Glob(filepath.Join(folder, fmt.Sprintf("node_%03d_*.eds", id)))
		one, err := m.net.AddRemoteNode(uint8(id), found[0])
		check(err, found[0])
		m.nodes[id] = one
		check(one.StartPDOs(true), "PDOs")
	}
	check(m.net.Command(0, nmt.CommandEnterOperational), "start")
	go func() {
		for id := 1; id <= 4; id++ {
			m.enable(id)
		}
	}()
	ticker := time.NewTicker(cycle)
	end := time.Now().Add(60 * time.Second)
	for still := 0; time.Now().Before(end) && still < 60; {
		<-ticker.C
		if !m.step() {
			break
		}
		if m.told.Stopped {
			still++
		}
	}
	line, _ := json.Marshal(m.told)
	fmt.Println(string(line))
}
