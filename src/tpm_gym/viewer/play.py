"""Tab "Play": episodes of tasks, with reward terms and torques plotted while they run."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from viser import GuiUplotHandle, ViserServer, uplot

import tpm_gym
from tpm_gym.errors import ConfigurationError
from tpm_gym.mechanism.machine import Machine
from tpm_gym.viewer.player import Player, installed_engines, policies_for
from tpm_gym.viewer.worker import Worker

_PADDED: Any = {"min": {"pad": 0.1}, "max": {"pad": 0.1}}
"""Range of a plot's vertical axis: the range of the plotted values, plus a tenth at each end."""
_COLOURS: Final = ("#0969da", "#d63031", "#2ea043", "#db8400", "#823cbe", "#118ab2")
_MOTORS: Final = ("motor 1", "motor 2", "motor 3")
_REDRAW: Final = 0.1
"""Shortest time between two drawings of the plots, s."""
_SPEEDS: Final = (0.1, 4.0)
"""Lowest and highest speed at which an episode is played; 1 is real time."""
_PAUSE: Final = 15
"""Control periods for which the end of an episode stays in view."""


class Play:
    """Controls of episodes.

    Args:
        server: The viser server; the controls are added to its present container.
        worker: Thread that runs the episodes.
        show: Called with the player after every reset and step.

    Attributes:
        player: Player of the episode. None before the first episode, and after another machine,
            environment, engine or policy is chosen.
        plots: Two dictionaries of plots: of the reward terms, and of the torques. In each, one plot
            is visible.
        status: Element of the panel that shows a line below the buttons.
    """

    def __init__(
        self, server: ViserServer, worker: Worker, show: Callable[[Player], object]
    ) -> None:
        """Add the controls."""
        self._worker, self._show = worker, show
        self._machine: Machine
        self.player: Player | None = None
        self.playing = False
        self._drawn, self._rest = 0.0, 0
        gui = server.gui
        ids = tpm_gym.ENV_IDS
        first = "TPMPickAndPlaceDense-v0"
        self.env_id: Any = gui.add_dropdown("Environment", ids, initial_value=first)
        self.engine = gui.add_dropdown("Engine", installed_engines())
        self.policy: Any = gui.add_dropdown("Policy", policies_for(self.env_id.value))
        self.file = gui.add_text(
            "Policy file", "", hint="Exported policy (.json); overrides Policy"
        )
        self.seed: Any = gui.add_number("Seed", 0, min=0, step=1)
        self.speed = gui.add_slider("Speed", *_SPEEDS, 0.1, 1.0, hint="1 is real time")
        self.buttons = gui.add_button_group("", ("Play", "Pause", "Step", "Next"))
        self.status: Any = gui.add_html("")
        self._gui = gui
        self.plots: list[dict[Any, GuiUplotHandle]] = [{}, {}]
        self._folders = [gui.add_folder(None) for _ in self.plots]
        self._connect()

    def _connect(self) -> None:
        for handle in (self.engine, self.policy, self.file):
            handle.on_update(lambda _: self._worker.ask("player", self.discard))
        self.env_id.on_update(lambda _: self._worker.ask("environment", self._set_env))
        self.speed.on_update(lambda _: self._worker.ask("speed", self._set_speed))
        self.seed.on_update(lambda _: self._worker.ask("seed", self.discard_episode))
        jobs = {
            "Play": self.play, "Pause": self.pause, "Step": self.step, "Next": self.new
        }  # fmt: skip
        self.buttons.on_click(lambda event: self._worker.ask("button", jobs[event.target.value]))

    # -- what the controls do -----------------------------------------------------------------

    def set_machine(self, machine: Machine) -> None:
        """Play with another machine from the next episode on."""
        self._machine = machine
        self.discard()

    def play(self) -> None:
        """Run the episode, and the episodes after it, at the speed in the panel."""
        self._ready()
        self.playing = True
        self._set_speed()

    def pause(self) -> None:
        """Pause the episode."""
        self._worker.stop_ticking()
        if self.playing:
            self.playing = False
            if self.player is not None and not self.player.ended:
                self._show(self.player)

    def step(self) -> None:
        """Run one control step."""
        self.pause()
        self._advance(self._ready())

    def new(self) -> None:
        """Begin the episode of the next seed."""
        if self.player is not None and self.player.records:
            self.seed.value += 1
        self._begin(self._made())

    def discard(self) -> None:
        """Close the environment; the next environment has the options of the panel."""
        self.pause()
        if self.player is not None:
            self.player.close()
        self.player = None

    def discard_episode(self) -> None:
        """Let the next step begin the episode of the panel's seed."""
        self._rest = 0
        if self.player is not None:
            self.player.ended, self.player.records = True, []

    def _set_env(self) -> None:
        self.discard()
        self.policy.options = policies_for(self.env_id.value)

    def _set_speed(self) -> None:
        low, high = _SPEEDS
        if not low <= self.speed.value <= high:  # pages can send any number
            raise ConfigurationError("speed", self.speed.value, f"a number from {low} to {high}")
        if self.playing:
            period = self._made().task.control_period
            self._worker.tick(period / self.speed.value, self._tick)

    # -- running ------------------------------------------------------------------------------

    def _made(self) -> Player:
        """Return the player, and make it if necessary."""
        if self.player is None:
            self.tell("Starting the engine; the first time it compiles for up to a minute.")
            path = self.file.value.strip()
            policy = str(Path(path).expanduser()) if path else self.policy.value
            self.player = Player(self.env_id.value, self.engine.value, self._machine, policy)
        return self.player

    def _ready(self) -> Player:
        """Return the player; start an episode if none is running."""
        player = self._made()
        if player.ended:
            self._begin(player)
        return player

    def _begin(self, player: Player) -> None:
        player.reset(int(self.seed.value))
        self._rest = _PAUSE
        self._show(player)
        self._plot(player)

    def _tick(self) -> None:
        player = self._made()
        if not player.ended:
            self._advance(player)
        elif self._rest > 0:
            self._rest -= 1
        else:
            self.new()

    def _advance(self, player: Player) -> None:
        player.step()
        self._show(player)
        if time.monotonic() - self._drawn > _REDRAW or player.ended or not self.playing:
            self._plot(player)

    # -- plots --------------------------------------------------------------------------------

    def _plot(self, player: Player) -> None:
        """Plot reward terms and torques, and show the state of the episode."""
        self._drawn = time.monotonic()
        records = player.records
        names = tuple(records[0].reward_terms) if records else ()
        steps = np.arange(1.0, len(records) + 1)
        terms = [[record.reward_terms[name] for record in records] for name in names]
        torques = np.array([record.torque for record in records]).reshape(-1, 3).T
        if records:
            self._draw(0, "Reward terms", names, [steps, *terms], player.length)
            self._draw(1, "Torques, N m", _MOTORS, [steps, *torques], player.length)
        total = sum(sum(record.reward_terms.values()) for record in records)
        success = bool(records) and records[-1].success
        verdict = "goal achieved" if success else "ended" if player.ended else "running"
        self.tell(f"Step {len(records)} of {player.length} · return {total:.2f} · <b>{verdict}</b>")

    def _draw(
        self, place: int, title: str, names: tuple[str, ...], rows: Sequence[Any], length: int
    ) -> None:
        """Show curves in one plot of ``self.plots[place]``, and hide the other plots of this group.

        Each combination of ``names`` and ``length`` has its own plot. The other plots are not
        removed, because a page may still have to process updates of them.

        Args:
            place: 0 for the reward terms, 1 for the torques.
            title: Title of the plot.
            names: Labels of the curves.
            rows: The numbers of the steps, then the values of each curve.
            length: Number of steps of a full episode.
        """
        key, data = (names, length), tuple(np.asarray(row, dtype=np.float64) for row in rows)
        plots = self.plots[place]
        for other, plot in plots.items():
            if plot.visible != (other == key):
                plot.visible = other == key
        if key in plots:
            plots[key].data = data
            return
        series = [
            uplot.Series(label=name, stroke=paint, width=2)
            for name, paint in zip(names, _COLOURS, strict=False)
        ]
        with self._folders[place]:
            plots[key] = self._gui.add_uplot(
                data,
                (uplot.Series(label="step"), *series),
                title=title,
                height=150,
                legend=uplot.Legend(show=True, live=False),
                scales={
                    "x": uplot.Scale(time=False, range=(0.0, float(length or 1000))),
                    "y": uplot.Scale(range=_PADDED),
                },
            )

    def tell(self, text: str) -> None:
        """Show a line below the buttons."""
        self.status.content = f'<div style="padding:0 1em 0.5em;font-size:0.85em">{text}</div>'
