module rollerrig-go-master

go 1.22

require github.com/samsamfire/gocanopen v1.4.4
