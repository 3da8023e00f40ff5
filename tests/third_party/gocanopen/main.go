// gocanopen as the master of the rig, and as its WSP unit (node 32).
//
// The master walks the drives to OPERATION ENABLED, turns a roller, reads speeds by PDO and drives
// the valves until the train has stopped. It simulates the inertia of the vehicle.
//
// Usage: master HOST PORT EDS_FOLDER; the port is the virtualcan port of the bench. The last line of
// the output is the result as JSON.
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

// node numbers; the drives are 1 to 4
const (
	drives    = 4
	speedUnit = 16
	brakeIO   = 17
	unit      = 32
)

const (
	cycle           = 10 * time.Millisecond
	heartbeatCycles = 5
	operational     = 5 // NMT state in a heartbeat
	cyclicVelocity  = 9 // mode of operation
	stateMask       = 0x6f
	statePatience   = 3 * time.Second
)

// the data sheet of the rig
const (
	rollerM     = 1.0
	wheelM      = 0.445
	massKg      = 43000.0
	inertiaKgm2 = 1200.0 // of a roller
	ratedNm     = 15000.0
)

// units of one count on the bus
const (
	wheelSpeedRadS  = 0.01
	rollerSpeedRadS = 1e-4
	torqueFraction  = 1e-3
)

const (
	// turning a roller: roller 1 runs faster than the others for some cycles, once the rig moves
	speedUp     = 1.05
	turnCycles  = 60
	rollingMrad = 4000.0 // angle of a roller that shows that the rig moves
	brakedMbar  = 100    // cylinder pressure

	// the master finishes when the train has stood for this many cycles
	standingCycles = 60
	longestRun     = 60 * time.Second
	// without this many readings of a turning wheel the train has not run yet
	readingsOfARun = 200
)

// steps to OPERATION ENABLED: a controlword, and the pattern of the statusword that answers it
var steps = []struct{ controlword, pattern uint16 }{{6, 0x21}, {7, 0x23}, {15, 0x27}}

// what has happened, for the test
type result struct {
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
	speed   float64 // of the simulated vehicle in m/s
	before  time.Time
	turning int // cycles in which roller 1 has been turned
	result  result
}

func check(err error, what string) {
	if err != nil {
		fmt.Fprintln(os.Stderr, what, err)
		os.Exit(1)
	}
}

// i32 returns a value that a PDO has brought into the local image of a node.
func (m *master) i32(id int, index uint16) float64 {
	value, _ := m.nodes[id].GetOD().Index(index).Uint32(0)
	return float64(int32(value))
}

// i16 returns a value that a PDO has brought into the local image of a node.
func (m *master) i16(id int, index uint16, sub uint8) float64 {
	value, _ := m.nodes[id].GetOD().Index(index).Uint16(sub)
	return float64(int16(value))
}

// wheelSpeed returns the speed at the rim of a wheel in m/s.
func (m *master) wheelSpeed(axle int) float64 {
	return m.i16(speedUnit, 0x6030, uint8(axle)) * wheelSpeedRadS * wheelM
}

// command sets a controlword in the local image of a node. The receive PDOs of the node carry it.
func (m *master) command(id int, word uint16) {
	check(m.nodes[id].GetOD().Index(0x6040).PutUint16(0, word, true), "controlword")
}

// enable walks a drive to OPERATION ENABLED.
func (m *master) enable(id int) {
	check(m.nodes[id].GetOD().Index(0x6060).PutUint8(0, cyclicVelocity, true), "mode")
	for _, step := range steps {
		m.command(id, step.controlword)
		deadline := time.Now().Add(statePatience)
		for {
			word, err := m.net.ReadUint16(uint8(id), 0x6041, 0)
			if err == nil && word&stateMask == step.pattern {
				break
			}
			if time.Now().After(deadline) {
				what := fmt.Sprintf("drive %d after controlword %d:", id, step.controlword)
				check(fmt.Errorf("statusword %04X, %v", word, err), what)
			}
			time.Sleep(5 * time.Millisecond)
		}
	}
	m.result.Enabled = append(m.result.Enabled, id)
}

// simulate advances the speed of the vehicle to now. While the train brakes, the torques of the
// drives act on the vehicle's inertia. Before, the vehicle has the speed of its wheels.
func (m *master) simulate() {
	now := time.Now()
	elapsed := now.Sub(m.before).Seconds()
	m.before = now

	mean := 0.0
	braked := false
	for axle := 1; axle <= drives; axle++ {
		mean += m.wheelSpeed(axle) / drives
		if m.i16(brakeIO, 0x6401, uint8(axle)) >= brakedMbar {
			braked = true
		}
	}
	if !braked {
		// The drives follow the targets of the first turn. From then on the wheels would only show
		// these targets, so the speed before the turn remains.
		if m.turning == 0 {
			m.speed = mean
		}
		return
	}

	torque := 0.0
	for id := 1; id <= drives; id++ {
		torque += m.i16(id, 0x6077, 0) * torqueFraction * ratedNm
	}
	// the rollers have a part of the vehicle's inertia
	simulatedKg := massKg - drives*inertiaKgm2/(rollerM*rollerM)
	m.speed = math.Max(0, m.speed-torque/rollerM/simulatedKg*elapsed)
}

// protect is a simple slide protection. It vents the brake of a wheel that slides much, and holds
// that of a wheel that slides.
func (m *master) protect() {
	bits := uint8(0)
	for axle := 1; axle <= drives; axle++ {
		sliding := m.speed - m.wheelSpeed(axle)
		if m.speed > 1 && sliding > 0.5+0.15*m.speed {
			bits |= 0b11 << (2 * (axle - 1))
			m.result.Vents++
		} else if m.speed > 1 && sliding > 0.3+0.05*m.speed {
			bits |= 0b01 << (2 * (axle - 1))
		}
	}
	// gocanopen sends its event-driven PDOs only after a change; the valves need one in every cycle
	frame := canopen.NewFrame(0x200+brakeIO, 0, 1)
	frame.Data[0] = bits
	_ = m.net.Send(frame)
}

// turnFactor returns by how much roller 1 runs faster than the others in this cycle.
func (m *master) turnFactor() float64 {
	// the rig may have waited for its unit
	rigMoves := m.i32(2, 0x6064) > rollingMrad
	if !rigMoves || len(m.result.Enabled) != drives || m.turning >= turnCycles {
		return 1.0
	}
	m.turning++
	if second := m.i32(2, 0x606c); second > 0 {
		m.result.Turned = math.Max(m.result.Turned, m.i32(1, 0x606c)/second)
	}
	return speedUp
}

// sendTargets sets the target velocities of the drives in their local images.
func (m *master) sendTargets() {
	factor := m.turnFactor()
	for id := 1; id <= drives; id++ {
		target := m.speed / rollerM / rollerSpeedRadS
		if id == 1 {
			target *= factor
		}
		check(m.nodes[id].GetOD().Index(0x60ff).PutUint32(0, uint32(int32(target)), true), "target")
	}
}

// noteStandstill notes the wheels that turn, and whether the train has run and has stopped.
func (m *master) noteStandstill() {
	still := true
	for id := 1; id <= drives; id++ {
		wheel := m.i16(speedUnit, 0x6030, uint8(id))
		if wheel != 0 {
			m.result.SpeedsRead++
		}
		still = still && wheel == 0 && m.i32(id, 0x606c) == 0
	}
	m.result.Stopped = m.result.SpeedsRead > readingsOfARun && still
}

// step runs one bus cycle. It returns false when the bus has closed.
func (m *master) step() bool {
	m.result.Cycles++
	m.simulate()
	m.protect()
	m.sendTargets()
	m.noteStandstill()
	if m.result.Cycles%heartbeatCycles == 0 {
		heartbeat := canopen.NewFrame(0x700+unit, 0, 1)
		heartbeat.Data[0] = operational
		if m.net.Send(heartbeat) != nil {
			return false
		}
	}
	sync := canopen.NewFrame(0x80, 0, 0)
	if m.net.Send(sync) != nil {
		return false
	}
	// The bus returns no frame to its sender. The synchronous PDOs of gocanopen wait for this one.
	m.net.BusManager.Handle(sync)
	return true
}

// connect opens the bus, and adds the nodes of the rig from their EDS files.
func (m *master) connect(host, port, folder string) {
	check(m.net.Connect("virtualcan", host+":"+port, 500000), "connect")
	for _, id := range []int{1, 2, 3, 4, speedUnit, brakeIO} {
		files, _ := filepath.Glob(filepath.Join(folder, fmt.Sprintf("node_%03d_*.eds", id)))
		remote, err := m.net.AddRemoteNode(uint8(id), files[0])
		check(err, files[0])
		m.nodes[id] = remote
		check(remote.StartPDOs(true), "PDOs")
	}
	check(m.net.Command(0, nmt.CommandEnterOperational), "start")
}

func main() {
	host, port, folder := os.Args[1], os.Args[2], os.Args[3]
	quiet := slog.New(slog.NewTextHandler(io.Discard, nil))
	slog.SetDefault(quiet)
	m := &master{net: network.NewNetwork(nil), nodes: map[int]*node.RemoteNode{}}
	m.net.SetLogger(quiet)
	m.connect(host, port, folder)

	// the drives need cycles while the master enables them
	go func() {
		for id := 1; id <= drives; id++ {
			m.enable(id)
		}
	}()
	ticker := time.NewTicker(cycle)
	end := time.Now().Add(longestRun)
	standing := 0
	for time.Now().Before(end) && standing < standingCycles {
		<-ticker.C
		if !m.step() {
			break
		}
		if m.result.Stopped {
			standing++
		}
	}
	line, _ := json.Marshal(m.result)
	fmt.Println(string(line))
}
