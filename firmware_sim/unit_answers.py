"""Whether a WSP unit that is alive still commands the valves.

In real time nothing waits for a unit. One that keeps its heartbeat and sends no more 211h leaves
the valves as they are, and the brake control that a run shall judge no longer acts. Only a unit
that has answered each SYNC is judged: one that sends its commands only when they change is allowed
in real time, and is silent whenever nothing changes.

SYNCs are counted, not time: a bench that stood still has sent none, so it takes no unit for silent.
"""

SILENT_AFTER_S = 0.5  # an assumption; a dead unit is lost, without its heartbeat, before
# SYNCs at least, with a long SYNC period
_FEWEST_SYNCS = 5
# a unit has answered each SYNC if this share of so many successive ones has an answer; the rest is
# jitter. The valves of a WSP unit do not change that often, so one that sends on change never has
_JUDGED_SYNCS = 100
_ANSWERED_SHARE = 0.95


def silent_after_syncs(sync_period_s: float) -> int:
    """Return the number of successive SYNCs without an answer after which a unit is silent."""
    return max(_FEWEST_SYNCS, round(SILENT_AFTER_S / sync_period_s))


class UnitAnswers:
    """The SYNCs and the answers of one unit.

    answers_each: it has answered each SYNC.
    silent: it has done so, and then left `silent_after` successive SYNCs without an answer.
    unanswered: SYNCs since its last answer, or since it was lost.
    since_ns: when these SYNCs began.
    """

    def __init__(self, silent_after: int) -> None:
        self.silent_after = silent_after
        self.answers_each = False
        self.silent = False
        self.unanswered = 0
        self.since_ns = 0
        self._syncs = 0
        self._answers = 0

    def start_anew(self, now_ns: int) -> None:
        """The unit has booted: what it answered before counts no longer."""
        self.answers_each = False
        self._syncs = 0
        self._answers = 0
        self.wait_again(now_ns)

    def wait_again(self, now_ns: int) -> None:
        """Count the SYNCs without an answer from here on."""
        self.unanswered = 0
        self.since_ns = now_ns

    def sync(self) -> bool:
        """Count a SYNC; return whether the unit is silent from now on."""
        is_silent = self.answers_each and self.unanswered >= self.silent_after
        becomes_silent = is_silent and not self.silent
        if becomes_silent:
            self.silent = True
        self._syncs += 1
        self.unanswered += 1
        return becomes_silent

    def answer(self, now_ns: int) -> bool:
        """Count an answer; return whether the unit was silent until now."""
        self._answers += 1
        self.wait_again(now_ns)
        # judged with an answer only, so a silence that goes on changes nothing
        if self._syncs >= _JUDGED_SYNCS:
            self.answers_each = self._answers >= _ANSWERED_SHARE * self._syncs
            self._syncs = 0
            self._answers = 0
        was_silent = self.silent
        self.silent = False
        return was_silent
