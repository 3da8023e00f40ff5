// Shows when the desk does not answer, and reports what was pressed and could not be sent.
//
// Before the page sends what somebody has pressed, it asks the desk for an answer. Without an answer nothing is
// sent, also not later: NiceGUI alone would keep it until the desk answers again. A rig must not start then.

// pause between two questions whether the desk answers, and between two looks at the time since its last answer
const ASK_PAUSE_MS = 500;
const LOOK_PAUSE_MS = 250;
// after this time without an answer the page is grey
const SILENCE_MS = 2000;
// how long a press waits for an answer; a desk that is busy may be late
const PATIENCE_MS = 5000;
// an event that follows a press after this time has another reason
const PRESS_MS = 1000;

const EMERGENCY_STOP = "Emergency stop";
const OWN_STOP = "In an emergency, use the rig's own emergency stop.";

const deskConnection = {
  lastAnswer: performance.now(), // time of the last answer, ms
  lastAnswerClock: new Date(), // the same as a time of day
  pressed: "", // text of the button that was pressed last
  pressedAt: -Infinity, // ms
  sending: Promise.resolve(), // what was pressed, one after another
  guarded: null, // the socket that `guard` has changed

  begin() {
    document.addEventListener("click", (event) => this.remember(event), true);
    document.addEventListener("visibilitychange", () => {
      // a page that was hidden has asked nothing
      this.lastAnswer = performance.now();
    });
    this.ask();
    setInterval(() => this.look(), LOOK_PAUSE_MS);
  },

  // Asks again and again while the page is visible.
  async ask() {
    if (!document.hidden) await this.answers(SILENCE_MS);
    setTimeout(() => this.ask(), ASK_PAUSE_MS);
  },

  // Returns whether the desk answers within this time.
  async answers(patience_ms) {
    try {
      const signal = AbortSignal.timeout(patience_ms);
      const response = await fetch("/desk/alive", { cache: "no-store", signal });
      if (!response.ok) return false;
    } catch (error) {
      return false;
    }
    this.lastAnswer = performance.now();
    this.lastAnswerClock = new Date();
    return true;
  },

  isSilent() {
    return performance.now() - this.lastAnswer > SILENCE_MS;
  },

  // Makes the page grey while the desk is silent, with a line at its foot.
  look() {
    if (window.socket && window.socket !== this.guarded) this.guard(window.socket);
    if (document.hidden) return;
    const silent = this.isSilent();
    document.body.classList.toggle("desk-silent", silent);
    if (!silent) {
      document.getElementById("desk-silence")?.remove();
      return;
    }
    const time_s = desk.newestValue("time_s");
    const sample = time_s === null || time_s === undefined ? "none" : `t = ${time_s.toFixed(2)} s`;
    this.place("desk-silence", "desk-silence").textContent =
      `The desk has not answered since ${this.lastAnswerClock.toLocaleTimeString()}. Last sample: ${sample}. ` +
      `What is pressed now is not sent, also not later. ${OWN_STOP}`;
  },

  // Returns the element with an id; makes it at the end of the page if it is not there.
  place(id, className) {
    let element = document.getElementById(id);
    if (!element) {
      element = document.createElement("div");
      element.id = id;
      element.className = className;
      element.setAttribute("role", "alert");
      document.body.append(element);
    }
    return element;
  },

  remember(event) {
    const button = event.target.closest?.("button, [role=button], [role=tab], [role=option]");
    if (!button) return;
    this.pressed = button.textContent.trim();
    this.pressedAt = performance.now();
  },

  // Makes the socket of NiceGUI send an event only when the desk has answered.
  guard(socket) {
    this.guarded = socket;
    const send = socket.emit.bind(socket);
    socket.emit = (name, ...values) => {
      if (name !== "event") return send(name, ...values);
      const pressed = performance.now() - this.pressedAt < PRESS_MS ? this.pressed : "";
      this.sending = this.sending.then(async () => {
        const answered = !this.isSilent() && (await this.answers(PATIENCE_MS));
        if (answered && socket.connected) send(name, ...values);
        else this.report(pressed);
      });
      return socket;
    };
  },

  // Reports what could not be sent, until somebody confirms it.
  report(pressed) {
    const emergency = pressed === EMERGENCY_STOP;
    const box = this.place("desk-not-sent", "desk-not-sent");
    // an emergency stop that was not sent stays in view, whatever was pressed after it
    if (box.classList.contains("desk-emergency")) return;
    box.classList.toggle("desk-emergency", emergency);

    const what = pressed ? `"${pressed}"` : "a change of a value";
    const title = document.createElement("b");
    title.textContent = emergency ? "THE EMERGENCY STOP WAS NOT SENT" : `NOT SENT: ${what}`;
    const text = document.createElement("p");
    text.textContent = emergency
      ? "Use the rig's own emergency stop now. The desk does not answer."
      : `The desk does not answer. It will not be sent later: press again when the desk answers. ${OWN_STOP}`;
    const button = document.createElement("button");
    button.textContent = "Close";
    button.addEventListener("click", () => box.remove());
    box.replaceChildren(title, text, button);
  },
};

deskConnection.begin();
