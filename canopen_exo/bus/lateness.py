"""How late things were: a histogram with logarithmic bins that can be merged and written as JSON.

Eight bins to the octave, in whole nanoseconds: a percentile is exact to 12.5 %, counts and the worst value are exact.
"""

from bisect import bisect_right
from typing import Final, TypedDict, final

from canopen_exo.errors import CanopenExoError

_BINS: Final = 8 * 58 + 16
"""Bins for all values below 2**62 ns."""

_TOP_NS: Final = (1 << 62) - 1

_FEW: Final = 12
"""Fewer delays than these are counted one by one."""


def _lower(index: int) -> int:
    """The smallest value of a bin: 0..15 have one each; from there eight to the octave."""
    if index < 16:
        return index
    octave = (index >> 3) - 1
    return (index - (octave << 3)) << octave


_EDGES: Final = [_lower(index) for index in range(1, _BINS)]
"""`bisect_right` finds the bin of a value in them: the first of what is negative, the last of what is too large."""


class LatenessDocument(TypedDict):
    """As in JSON. bins: pairs of lower edge [ns] and count, the empty ones left out; percentiles in ns."""

    count: int
    worst_ns: int
    p50_ns: int
    p90_ns: int
    p99_ns: int
    p999_ns: int
    bins: list[list[int]]


@final
class Lateness:
    """A distribution of delays, ns. count: values so far; worst_ns: the largest, exact."""

    def __init__(self) -> None:
        self.count: int = 0
        self.worst_ns: int = 0
        self._bins: Final[list[int]] = [0] * _BINS

    def add(self, delay_ns: int) -> None:
        """Count one delay; a negative one counts as 0."""
        self.count += 1
        if delay_ns > self.worst_ns:
            self.worst_ns = delay_ns
        self._bins[bisect_right(_EDGES, delay_ns)] += 1

    def add_since(self, times: list[int], now: int) -> None:
        """Count the delays of these times, in ascending order, until `now`."""
        left = len(times)
        self.count += left
        if left and now - times[0] > self.worst_ns:
            self.worst_ns = now - times[0]
        if left < _FEW:
            bins = self._bins
            for time_ns in times:
                bins[bisect_right(_EDGES, now - time_ns)] += 1
            return
        while left:  # bin by bin, from the shortest
            index = bisect_right(_EDGES, now - times[left - 1])
            first = bisect_right(times, now - _lower(index + 1), 0, left)
            self._bins[index] += left - first
            left = first

    def percentile(self, share: float) -> int:
        """The delay [ns] that at least `share` (0..1) of the values do not exceed: its bin's upper edge."""
        if not 0.0 <= share <= 1.0:
            raise CanopenExoError(f"lateness: percentile of share {share} asked for, allowed 0..1 (0.99 for 99 %)")
        wanted = share * self.count
        seen = 0
        for index in range(_BINS):
            seen += self._bins[index]
            if seen and seen >= wanted:
                return min(_lower(index + 1) - 1, self.worst_ns)
        return 0

    def merge(self, other: "Lateness") -> None:
        """Add the values of `other` to these."""
        self.count += other.count
        self.worst_ns = max(self.worst_ns, other.worst_ns)
        for index in range(_BINS):
            self._bins[index] += other._bins[index]

    def words(self) -> str:
        """For people, in ms."""
        if not self.count:
            return "none"
        shares = ", ".join(f"{share} % within {self.percentile(share / 100) / 1e6:.1f} ms" for share in (50, 90, 99))
        return f"{self.count}, {shares}, the latest {self.worst_ns / 1e6:.1f} ms"

    def document(self) -> LatenessDocument:
        """For JSON."""
        bins = [[_lower(index), number] for index, number in enumerate(self._bins) if number]
        return {
            "count": self.count,
            "worst_ns": self.worst_ns,
            "p50_ns": self.percentile(0.5),
            "p90_ns": self.percentile(0.9),
            "p99_ns": self.percentile(0.99),
            "p999_ns": self.percentile(0.999),
            "bins": bins,
        }

    @staticmethod
    def from_document(document: LatenessDocument) -> "Lateness":
        """The distribution that `document` was made from; raises CanopenExoError when it is none."""
        lateness = Lateness()
        try:
            for lower, number in document["bins"]:
                if not (type(lower) is int and type(number) is int and 0 <= lower <= _TOP_NS and number >= 0):
                    raise ValueError(f"bin {[lower, number]}")
                lateness._bins[bisect_right(_EDGES, lower)] += number
                lateness.count += number
            lateness.worst_ns = int(document["worst_ns"])
            if lateness.count != document["count"]:
                raise ValueError(f"count {document['count']} beside bins that hold {lateness.count}")
        except (KeyError, TypeError, ValueError) as error:
            raise CanopenExoError(
                f"lateness: no distribution: {error}; allowed is what Lateness.document() wrote"
            ) from error
        return lateness
