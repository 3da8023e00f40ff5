// Draws what the bench tells. The page asks for new rows when it has drawn the last ones: a browser that stands
// still asks for nothing, and nothing is kept for it.
window.desk = {
  given: null, bench: "", next: 0, rows: [], whole: false, axle: 0, angles: [0, 0, 0, 0], then: 0, held: null,

  begin(given) {
    this.given = given;
    this.at = Object.fromEntries(given.columns.map((name, at) => [name, at]));
    this.drawWheels();
    this.go();
    requestAnimationFrame((now) => this.turn(now));
  },

  async go() {
    let pause = 100;
    try {
      if (!document.hidden && document.getElementById("desk-time")) {
        await this.ask();
        const begun = performance.now();
        this.draw();
        const took = performance.now() - begun;
        pause = this.whole ? 1000 : Math.max(100 - took, 2 * took);
      }
    } catch (error) {
      pause = 1000;
      const place = document.getElementById("desk-time");
      if (place) place.textContent = "the desk does not answer";
    }
    setTimeout(() => this.go(), pause);
  },

  async ask() {
    const about = `bench=${this.bench}&after=${this.next}&whole=${this.whole ? 1 : 0}`;
    const answer = await fetch(`/desk/rows?${about}`);
    if (!answer.ok) throw new Error(answer.status);
    const told = await answer.json();
    if (told.bench !== this.bench) { this.rows = []; this.bench = told.bench; }
    this.held = told.held_m_s;
    this.newest = told.newest;
    this.next = told.points;
    if (this.whole) this.rows = told.rows;
    else {
      this.rows = this.rows.concat(told.rows);
      const last = this.rows.length ? this.rows[this.rows.length - 1][0] : 0;
      const first = this.rows.findIndex((row) => row[0] >= last - this.given.span_s);
      if (first > 0) this.rows.splice(0, first);
    }
  },

  show(axle, whole) {
    this.axle = axle;
    if (whole !== this.whole) { this.rows = []; this.next = 0; this.whole = whole; }
  },

  draw() {
    const rows = this.rows, last = rows.length ? rows[rows.length - 1][0] : 0;
    const first = this.whole ? 0 : Math.max(0, last - this.given.span_s);
    for (const plot of this.given.plots) {
      const chart = getElement(plot.id)?.chart;
      if (!chart || chart.isDisposed()) continue;
      const series = plot.lines.map((line) => {
        const at = this.at[line.column], mine = !this.axle || !line.axle || line.axle === this.axle;
        return { id: line.column, data: mine ? rows.map((row) => [row[0], row[at] === null ? null : row[at] * plot.scale]) : [] };
      });
      chart.setOption({ xAxis: { min: first, max: Math.max(last, first + 1) }, series }, { lazyUpdate: true });
    }
    this.lanes(first, Math.max(last, first + 1));
    this.figures();
  },

  figures() {
    const put = (name, text) => { document.getElementById(`desk-${name}`).textContent = text; };
    const now = this.newest, of = (name) => now?.[this.at[name]];
    const speed = this.held ?? of("vehicle_speed_m_s");
    const number = (value, places) => (value === null || value === undefined ? "–" : value.toFixed(places));
    put("time", now ? `${number(of("time_s"), 1)} s` : this.held !== null ? "held" : "no bench");
    put("speed", number(speed === null || speed === undefined ? null : 3.6 * speed, 1));
    put("distance", number(of("position_m"), 0));
    put("demand", number(now ? of("brake_demand_Pa") / 1e5 : null, 2));
    put("sliding", number(now ? 3.6 * Math.max(...[1, 2, 3, 4].map((axle) => of(`sliding_${axle}_m_s`))) : null, 1));
    put("missed", number(of("ticks_missed"), 0));
    put("late", number(of("tick_lateness_us"), 0));
  },

  lanes(first, last) {
    const canvas = document.getElementById("desk-valves");
    if (!canvas) return;
    const width = (canvas.width = canvas.clientWidth), height = canvas.height, pen = canvas.getContext("2d");
    const left = 56, right = 14, lane = height / 4;
    pen.clearRect(0, 0, width, height);
    pen.font = "11px sans-serif";
    for (let axle = 1; axle <= 4; axle++) {
      const at = this.at[`valve_${axle}`], top = (axle - 1) * lane;
      pen.fillStyle = this.given.axles[axle - 1];
      pen.fillText(`axle ${axle}`, 6, top + lane / 2 + 4);
      if (this.axle && this.axle !== axle) continue;
      const x = (time) => left + ((time - first) / (last - first)) * (width - left - right);
      for (let k = 0; k + 1 < this.rows.length; k++) {
        const state = this.rows[k][at] ?? 0;
        pen.fillStyle = this.given.valves[Math.min(2, Math.round(state))];
        const from = x(this.rows[k][0]);
        pen.fillRect(from, top + 2, Math.max(1, x(this.rows[k + 1][0]) - from + 0.5), lane - 4);
      }
    }
  },

  drawWheels() {
    const places = [90, 190, 510, 610];
    const one = (x, axle) => `<circle cx="${x}" cy="126" r="24" class="desk-roller"/>
      <g id="desk-wheel-${axle}" style="transform-origin:${x}px 76px"><circle cx="${x}" cy="76" r="26" class="desk-wheel"
        style="stroke:${this.given.axles[axle - 1]}"/>${[0, 60, 120].map((turn) => `<line x1="${x - 24}" y1="76"
        x2="${x + 24}" y2="76" transform="rotate(${turn} ${x} 76)" class="desk-spoke"/>`).join("")}</g>
      <text x="${x}" y="164" class="desk-text" id="desk-lock-${axle}">${axle}</text>`;
    document.getElementById("desk-rig").innerHTML = `<svg viewBox="0 0 700 170" width="100%" height="150">
      <rect x="30" y="6" width="640" height="40" rx="9" class="desk-coach"/>
      ${places.slice(0, 2).map((x) => `<line x1="${x}" y1="50" x2="${x}" y2="76" class="desk-frame"/>`).join("")}
      ${places.slice(2).map((x) => `<line x1="${x}" y1="50" x2="${x}" y2="76" class="desk-frame"/>`).join("")}
      <rect x="64" y="46" width="152" height="7" class="desk-bogie"/><rect x="484" y="46" width="152" height="7" class="desk-bogie"/>
      ${places.map((x, at) => one(x, at + 1)).join("")}</svg>`;
  },

  turn(now) {
    const passed = Math.min(0.1, (now - this.then) / 1000);
    this.then = now;
    for (let axle = 1; axle <= 4; axle++) {
      const wheel = document.getElementById(`desk-wheel-${axle}`);
      const speed = this.held ?? this.newest?.[this.at[`wheel_circumferential_speed_${axle}_m_s`]] ?? 0;
      const vehicle = this.held ?? this.newest?.[this.at.vehicle_speed_m_s] ?? 0;
      const locked = vehicle > this.given.moving_m_s && speed < this.given.locked_m_s;
      if (!wheel) continue;
      this.angles[axle - 1] += (passed * speed) / this.given.radius_m / 20;
      wheel.style.transform = `rotate(${this.angles[axle - 1]}rad)`;
      wheel.classList.toggle("desk-locked", locked);
      document.getElementById(`desk-lock-${axle}`).textContent = locked ? `${axle}: locked` : `${axle}`;
    }
    requestAnimationFrame((next) => this.turn(next));
  },
};
