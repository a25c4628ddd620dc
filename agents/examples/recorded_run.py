"""A recorded run in pandas: speeds asked for, sent and measured, odometry, and lateness.

    pip install ".[record,plot]" pandas
    acsar-gym run 1.5 0.5 --link /dev/ttyUSB0 --record drive.mcap   # or evaluate, drive; any link
    python agents/examples/recorded_run.py drive.mcap --plot drive.png

`acsar-gym record export drive.mcap --to parquet` writes the same tables for other programs.
"""

from pathlib import Path
from typing import Annotated

import numpy as np
import pandas as pd
import tyro
from matplotlib.figure import Figure

from acsar_gym.recording import read
from acsar_gym.recording.export import iterate_tables


def summed_up(ticks: pd.DataFrame) -> pd.Series:
    """Sum up an episode: SI units, and milliseconds of lateness, which simulations don't have."""
    lags = {lag: ticks.linear.corr(ticks.sent_linear.shift(lag)) for lag in range(50)}
    period, late = ticks.stamp.diff().median(), 1e3 * ticks.lateness.dropna()
    return pd.Series(
        {
            "duration": ticks.stamp.iloc[-1] - ticks.stamp.iloc[0],
            "path by odometry": np.hypot(ticks.x.diff(), ticks.y.diff()).sum(),
            "limited ticks": (ticks.reason != 0).mean(),
            "linear, asked - sent": (ticks.asked_linear - ticks.sent_linear).abs().mean(),
            "linear, sent - measured": (ticks.sent_linear - ticks.linear).abs().mean(),
            "angular, sent - measured": (ticks.sent_angular - ticks.angular).abs().mean(),
            "measured after sent": max(lags, key=lambda lag: lags[lag]) * period,
            "late, median": late.median(),
            "late, 99 %": late.quantile(0.99),
        }
    )


def main(
    recording: Annotated[Path, tyro.conf.Positional], plot: Path = Path("run.png")
) -> pd.DataFrame:
    """Print a table with a column for each episode, and draw the last one."""
    tables = iterate_tables(read(recording))
    parts = [pd.DataFrame(columns) for name, columns in tables if name == "ticks"]
    ticks = pd.concat(parts, ignore_index=True)
    found = pd.DataFrame({number: summed_up(each) for number, each in ticks.groupby("episode")})
    print(found.round(3).to_string())
    last = ticks[ticks.episode == ticks.episode.max()].set_index("stamp")
    speeds, way, late = Figure(figsize=(12, 4), layout="constrained").subplots(1, 3)
    last[["asked_linear", "sent_linear", "linear"]].plot(ax=speeds, xlabel="s", ylabel="m/s")
    last.plot(x="x", y="y", ax=way, legend=False, xlabel="x, m", ylabel="y by odometry, m")
    way.set_aspect("equal", adjustable="datalim")
    last.lateness.mul(1e3).plot(ax=late, xlabel="s", ylabel="late, ms")
    late.figure.savefig(plot)
    return found


if __name__ == "__main__":
    tyro.cli(main)
