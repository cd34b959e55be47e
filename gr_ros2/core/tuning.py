"""The constants of the engines that were found by measurement, each with what it is and what measured it.

What follows from the wire format, bounds memory, keeps forgers out or is about one computer stands in the module that
it concerns. Times hold for packets that come as often as ``turn_s`` says, and are longer on a slow channel
(``Settings.slower``).

Invariant: it holds values only, and nobody changes them: whoever wants others passes in another ``Tuning``, as
``python -m bench constants`` does. What that bench varies without a word here was measured by it.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Tuning:
    """The constants of one robot's engines."""

    turn_s: float = 1 / 3
    """s from one packet of a robot to its next up to which times hold as they are written: some packets of others,
    whatever their airtime. Twenty robots in one cell at 75 packets/s have a turn so often (``bench cells``)."""

    # ---- which message goes next

    turn_every: int = 4
    """One packet in this many belongs to the topic whose last turn is longest ago."""
    fragment_part: int = 2
    """A fragment must fill at least one part in this many of a packet's room: a message in more packets than it needs
    is lost with any of them. With 3, the scans of ``six-topics-paced`` are 3 % younger without loss, and 16 % older at
    20 % loss (``bench saturated``). A message of class latency uses any space that is free."""
    long_packets: int = 64
    """A message of more packets goes after all others of its class, into the room that these leave. Odometry at 35 Hz
    beside 1 MB is then 1.05 times as old as without it; by value alone 1.4 times, because the last 60 kB go before it
    (``bench repair_backlog``)."""
    age_part: int = 8
    """One part in this many of the time for which a message is of use may pass at its origin without being told.
    Commands of four robots in a line with slots of 13 ms then have an age in 36 % of the packets, all of which together
    are 2 % longer; with 4 in 2 %, with 16 in 65 % (4 %). If it were always told, they would be 6 % longer."""

    # ---- repairs

    repair_enough: float = 0.05
    """Expected number of lost packets that is too small for a repair. With 0, odometry takes 8 % more packets at 1 %
    loss and is no younger."""
    repair_under_way: float = 1.0
    """Packets that a repair under way is taken to bring back, where it arrives."""
    repair_worth: float = 0.85
    """Part of ``hold_s`` for which a message is repaired after the next one of its topic has left, while nobody
    reports. A receiver goes on without it after ``hold_s``; what comes back later than that is of no use."""
    repair_patience_s: float = 0.2
    """s for which a receiver waits in vain for a packet before it is told so in front of new messages."""
    repair_poll_s: float = 0.02
    """s after which a thrifty sender that is in doubt checks again."""
    repair_calm_poll_s: float = 0.1
    """The same while no receiver loses packets, s."""
    repair_most_ahead: int = 16
    """Repairs in a row that go before new messages. Without a bound, new messages had to wait for 40 s after an outage
    of 300 s at 10 Hz, and those that their queue had no room for were lost."""
    repair_yields: int = 8
    """Times that a repair for which later messages wait lets messages of class latency go first. Where these still wait
    then, every second packet may be such a repair: with fewer, repairs could not keep up with 30 % of the packets lost,
    and with none, nothing in order came out any more. With 1, 2 % of the commands in loaded meshes came too late."""
    window_step: float = (5**0.5 - 1) / 2
    """Part of all live packets by which the window of a repair moves on: the golden section, which spreads any number
    of windows evenly."""
    gap_packets: int = 64
    """Missing packets in a row of which it is found out what they can have carried, at most. With 0, odometry beside
    1 MB is 1.48 times as old as without it at 20 % loss, otherwise 1.28 times (``bench repair_backlog``)."""
    order_smoothing: float = 1 / 16
    """How fast the share of missing packets that come back is learned. With a quarter, messages of a sender that
    repairs nothing are 38 % younger at first, but one way at 55 Hz and 20 % loss 1.3 % of them are lost in addition."""
    order_anew: int = 4
    """Times that a message may wait anew for others, because a robot is heard, in the time for which it waits."""

    # ---- repairs that wait for the next message

    hold_overlap: float = 1 / 2
    """Part of a packet's airtime by which a repair may delay a message. With a quarter, odometry at 20 % loss one way
    is 17 % older at 40 Hz; with none, another 9 %."""
    hold_surplus: float = 2.5
    """Repairs owed per packet that is expected to be lost. With 1, a sixteenth of the messages at 45 and 50 Hz are lost
    one way at 20 % loss, and odometry is 6 to 7 times as old; with 2.5 none is. With 4, it is older by a sixth at 37.5
    Hz, where a repair just fits between two messages."""
    hold_most_owed: float = 2.0
    """Repairs owed at most."""
    hold_smoothing: float = 1 / 8
    """How fast the period of a topic is learned."""
    hold_late: float = 1 / 4
    """Part of a topic's period for which its next message is waited for after its time. Where messages come at random,
    in pairs or with gaps, they are no older than if nothing waited."""
    hold_most_in_vain: int = 6
    """Waits in vain that are counted: at most 4^5 repairs go without waiting before the next one waits. With none,
    odometry in slots is 14 % older with reports, and three times as old one way, at 20 % loss."""
    hold_gain: float = 1 / 16
    """Part of a packet's airtime that a wait must gain to be worth it. With 0, odometry one way is 8 % older, and its
    p99 42 % longer."""

    # ---- repairs while nobody reports

    unreported_most_loss: float = 0.5
    """Loss up to which repairs are sent without reports in proportion to it."""
    unreported_enough: float = 1.0
    """Times that the repairs which are enough for the expected losses leave before a packet is over."""
    unreported_owed: float = 1.0
    """Repairs of a long message that are owed, from which on one goes before new packets."""
    unreported_together: int = 6
    """While all peers are out of range, each new packet allows as many repairs as are enough for this many packets,
    divided by their number: 2.0. Without a bound, an outage of 30 s beside odometry at 35 Hz took 887 kB of repairs
    instead of 395. Who hears and is not heard, at 10 and 20 % loss, gets as many messages of a topic without reliable
    publishers as without a bound, 98.7 and 97.3 % (98.7 and 98.1 %), with 20 here 98.1 and 95.7 %; messages in order
    are younger, since repairs of what it has do not go before those of what it lacks: 12 ms instead of .95 s at 35
    Hz."""
    unreported_meeting_s: float = 5.0
    """s after the start of a robot in which it does not fall silent, where packets are taken only after a proof.
    Without it, a message that was said once at the start came never, if the hello of the other robot came after its
    repairs: on a busy computer, in one of three starts."""

    # ---- repairs and reports on a channel that many share

    shared_told_times: float = 2
    """Mean times between two new packets for which reports may be older than what a repair has told all peers: that
    something is not repaired any more (``bench reliable``)."""
    shared_owed: float = 0.5
    """Packets expected to be lost of a message in order after which a repair follows it at once (``bench
    reliable``)."""
    shared_within: int = 64
    """Packets of a message in order from which on its repairs do not wait for its end (``bench reliable``)."""
    shared_most_owed: float = 2
    """Packets expected to be lost from which on repairs do not wait for the end of a message. Where one message follows
    the other, repairs could not keep up with the losses otherwise (``bench reliable``)."""
    shared_kept_up: float = 0.75
    """Loss up to which repairs keep up where something new always waits. With more they would take three quarters of
    all packets in vain: beside one of four robots that loses 80 %, the others got 13 % less odometry then; now 5 %."""
    shared_reports: float = 0.05
    """Most of the bytes of all packets that reports take (``bench reliable``)."""
    shared_reports_at_once: int = 8
    """Most reports in one packet."""
    shared_reports_first: int = 4
    """Reports that may leave at once after the start, on a slow channel. Without them, where packets take half a
    second, what each of three robots with a key has sent before another one had proven itself is missing there until a
    report comes after 15 s: all have heard each other after 37 instead of 28 s (median), nine in ten after 64 instead
    of 41. 2: 31 and 62 s; 8: as 4 (``bench first``)."""
    shared_report_waits_s: float = 10.0
    """s after which a report that only confirms goes before newer ones of what is missed. Of two neighbours of which
    one always misses something, the other is never told otherwise what has arrived, and repairs it for ever."""

    # ---- reports

    report_every: int = 5
    """Packets received from one report to the next; more while none is lost."""
    report_per_arrived: int = 16
    """Packets that arrive for which one report before its time is allowed, because something was lost or a slot is
    free. With a report for every packet where the reverse is free, 43 % of the demo's packets were reports, and a slow
    computer had no time for messages; now 28 % are (``bench slow_computer``)."""
    report_per_loss: float = 3
    """Such reports for each packet that is lost. With 2.5, odometry beside a backlog at 20 % loss is 1.33 times as old
    as alone, with 3 it is 1.27 times (``bench repair_backlog``)."""
    report_per_vain: float = 1.5
    """Such reports for each repair of what is here. With none, a sender without a pace sent 1,115 repairs of 70 lost
    packets, with 1.5 it sends 278. With .5, and 1 for each loss, 24 % of the demo's packets are reports, and the oldest
    topic is 1.06 s old instead of .91 (``bench slow_computer``)."""
    report_most_saved: float = 8.0
    """Such reports that are saved up."""
    report_smoothing: float = 1 / 32
    """How fast the share of lost packets is learned."""
    report_pause_s: float = 0.1
    """s after which a report is due, even about a single packet, at first and after a loss."""
    report_calm_s: float = 1.0
    """The same at most. With .5, the reports of a link without losses cost as much again, and at .2 to 2 % loss
    messages of 2 to 35 Hz are no younger."""
    report_calm_loss: float = 1 / 128
    """Share of lost packets up to which reports become rarer."""
    report_slower: float = 1.1
    """By how much the time between two reports grows then. The sender expects reports at their recent interval, so that
    it must not grow faster."""
    report_again_s: float = 0.5
    """s after which a report is repeated while messages wait for an earlier one. Without it, commands before a silence
    wait 7 % longer at 40 % loss both ways (40 seeds of ``bench.uneven``)."""
    report_prompt_loss: float = 1 / 64
    """Share of packets lost from which on every packet is reported at once, if that takes no slot from anything. The
    sender then notices a missing report as soon as it is overdue, and repairs without waiting for the next packet. With
    twice as much, odometry at 1 % loss takes 29 % fewer reports, but its p99 at 5 % loss is 8 % longer."""
    report_oldest: int = 2
    """One report in this many is about the oldest missing packets, where the newest ones are too far from them."""
    report_confirm_s: float = 1.0
    """s between two reports to a sender of which nothing is missed or heard since, on a channel that many share
    (``bench reliable``)."""
    report_forced: int = 20
    """New packets after which a report or a request that found no room gets a packet of its own: 5 % of the slots. It
    is less where packets are lost, since of reports more are lost then, and each says of 32 packets what is missing."""

    # ---- what is expected of those who report

    peer_under_way_s: float = 1e-3
    """s for which a packet or a repair is under way at least. Without it, a sender with no pace would repair without
    end where a report comes at once."""
    peer_delays: int = 16
    """Newest times of reports from which the shortest and the longest are taken. Without the shortest, packets are
    repaired whose reports are under way: odometry takes 38 % more packets where reports take eight slots."""
    peer_interval_s: float = 0.1
    """s between two reports of a peer, until its reports tell. With 0, a sender repairs packets before the first report
    can come: three of 141 on ``paper-ofdm-paced`` without losses."""
    peer_silence: float = 8
    """Part of the time without a report for which a repair counts as under way. A message every .5 s to a robot that
    does not hear takes 623 packets a minute (4,241 without this, 396 with 4, 278 with 2). With 4, a single message at
    60 % loss takes 1.4 s instead of .9 s in the mean; with 2, one per second at 40 % loss is 48 ms old instead of
    38."""
    peer_later: float = 1.25
    """Times the longest time between two reports of late for which a peer that loses nothing may keep the next one
    back: that time grows by a tenth with each report."""
    peer_soon: float = 2
    """Mean times between two new packets within which a report must come to be waited for. Where reports take eight
    slots at 20 % loss both ways, odometry is 14 % older without it; where they come at once or take 20 slots, it
    changes nothing. With 1, odometry beside 1 MB at 20 % loss is 4 to 22 % older (``bench repair_backlog``)."""

    # ---- hellos, and what is kept for robots that join late

    hello_starting_s: tuple[float, ...] = (0.0, 0.1, 0.25, 0.5, 1.0)
    """Times in s after the start at which hellos are sent (``bench first``)."""
    hello_bytes_s: float = 50.0
    """Bytes/s that hellos take that are not early, as far as the interval stays between ``hello_often_s`` and
    ``hello_seldom_s``."""
    hello_often_s: float = 1.0
    """s between two hellos at least, once they are regular."""
    hello_seldom_s: float = 2.0
    """s between two hellos at most, while others are heard."""
    hello_lone_s: float = 10.0
    """Most s between two hellos of a robot that hears nobody and says nothing: the time doubles with each hello, as in
    Trickle (RFC 6206). A robot that starts is met at once, by its own hellos."""
    hello_early: float = 0.25
    """Part of the longest time to the next hello by which it comes early at most; RFC 5148 advises no more. The mean is
    the period: with one that is an eighth shorter, hellos make 1 in 100 messages late that fill a link one way."""
    hello_eager_s: float = 0.1
    """s between hellos while another robot has not proven yet that it heard this start: until then its messages are not
    delivered (``bench first``)."""
    hello_eager: int = 20
    """Number of these hellos."""
    hello_rests: int = 2
    """Packets of messages, if any wait, between two hellos on a slow channel where somebody has named this robot: a row
    of the table and its message, for example. Who is met would say nothing but hellos there for its next five turns.
    Where nobody has named it, its hello was lost, and nothing else tells who it is (``bench first``)."""
    hello_latency_s: float = 0.15
    """s for which a hello lets messages of class latency go first."""
    table_first: int = 2
    """Number of packets up to which the table of topics goes before messages."""
    table_share: float = 0.1
    """Part of the air that the table of topics takes at most where it follows every hello, since nobody reports. It
    comes every ``repeat_s`` in any case."""
    repeat_most: int = 32
    """Most ``repeat_s`` from one repeat of the kept messages to the next, while nobody is heard though somebody could
    be: the time doubles with each repeat, as in Trickle (RFC 6206). A robot that comes then asks for them."""
    kept_settling_s: float = 1.0
    """s after which a latched message is named in hellos: a receiver that lacks it then has lost it, not just not
    received it yet."""
    kept_starting_s: float = 2.0
    """s from the start during which the table is repaired even if no receiver reports; any other kept message is for so
    long beyond the time that it waited."""
    kept_answers: int = 3
    """Times that a message is sent again at once for robots that ask, after a time without need; then once in a pause.
    So those who join one after the other are answered at once, and forged requests take a tenth of the time at most in
    the long run."""
    kept_pause: float = 10
    """A pause, in times that the message takes on the air. The time that it waits does not count: three rows of a table
    that waited for seconds beside a backlog were refused for 40 s then."""
    kept_pause_s: float = 1.0
    """A pause at least, s."""
    ask_s: float = 0.5
    """s after which a request for a kept message is repeated."""
    ask_check_s: float = 0.02
    """s between two checks of what is missing."""

    # ---- what is sent on of other robots

    gain_own: float = 0.7
    """Share of the way from what a neighbour was taken to have to a message that this robot sends, which it should have
    heard then (``bench relay``)."""
    gain_others: float = 0.9
    """The same of a message of a robot that it hears (``bench relay``)."""
    gain_likely: float = 0.5
    """Messages by which all neighbours together are taken to be behind, from which on one is likely to lack the
    newest."""
    gain_unknown_s: float = 10.0
    """By how much younger a stream's first message is taken to make a robot, s."""
    gain_known_s: float = 1.0
    """By how much younger a table makes a robot at most that knows it, s: it tells only that its robot is still there.
    Without this, tables that are sent again starved those that a robot lacks, for ever where there is no room for
    all."""
    gain_first_period_s: float = 0.1
    """s from one number of a stream to the next, before two are known."""
    gain_arrivals: int = 16
    """Numbers of a stream from whose times its period follows."""
    gain_told: int = 2
    """Streams of which a packet tells the newest number (``bench relay``)."""
    gain_even: float = 4
    """Robots of a line or a grid have up to 4 messages of equal worth, one that joins two groups 6. Among robots that
    all have much to relay, weights gain nothing and take the slots out of their order (``bench relay``)."""
    gain_smoothing: float = 0.1
    """Share by which this number follows from one choice to the next."""
    relay_again_s: float = 0.5
    """s after which a message is sent again that a robot still lacks."""
    relay_doubled: int = 6
    """This time is doubled so often at most."""
    relay_window: int = 32
    """Messages of a topic that are sent before a robot has told that it has the first of them."""
    relay_table_s: float = 5.0
    """s after which the table of a robot that is heard is worth sending on again: some may have come since."""
    relay_table_later: float = 2
    """A table of several packets is worth it so many times later for each of them. With packets of 64 bytes, sealed,
    one of four topics takes 14: every 5 s, tables of robots that are known left no time for that of another one over a
    line of four."""

    # ---- several radios, whose packets overtake each other, by ``bench radios``

    bond_like: float = 1.25
    """Airtime of a packet, over that of the fastest radio, up to which a radio shares the load. With 2, packets of the
    slower one count as lost before they can have come."""
    bond_weight: float = 1 / 16
    """Weight of the newest packet in the share of them that comes over a radio: eleven that do not come end its
    turn."""
    overtaken_most_s: float = 0.02
    """s for which a message waits at most; what comes later has not been overtaken."""
    overtaken_some: float = 0.01
    """Share of packets that are overtaken from which on messages wait."""
    overtaken_share_weight: float = 1 / 64
    """Weight of the newest packet in that share."""
    overtaken_time_weight: float = 1 / 16
    """Weight of the newest one that was overtaken in how late these are."""
    overtaken_times: float = 4
    """How much longer than the mean of these is waited: 95 % have come then."""

    # ---- slots, by ``bench mac``

    slots_listen: int = 24
    """Slots for which a robot listens at most before it enters. With 12, one of 20 whose clock has jumped by 1 s may
    collide with others 5 s later."""
    slots_quiet: int = 4
    """The same at least, and where nobody is heard. With 24, two robots hear each other after 31 slots instead of 15
    (median), 50 from cold after 521 instead of 548. With 3, it is the same as with 4."""
    slots_listen_frames: int = 2
    """The same in frames of those it hears, since each has announced its slots in one."""
    slots_filled: float = 0.5
    """Part by which the frame may be longer for video: no robot's turn comes 1.5 times as late as without it."""
    slots_choice: int = 4
    """Free slots among which a robot picks at random where it does so."""
    slots_mixed: float = 0.02
    """Share of picks at random where nothing calls for it: of two neighbours in step each may be heard by all
    others."""
    slots_named: float = 2.2
    """Frames for which a robot that was heard is named: one packet of it may be lost."""
    slots_unsure: float = 1.75
    """Frames without being named, of which each has two names for each robot, after which a robot may be in step with
    another one."""
    slots_known_late: int = 9
    """Slots that this is at least: a host knows a packet some slots after it began, and composes its own ahead. Without
    it two links on one computer (6 ms a slot) picked at random half of the time, and sent 27 instead of 41 packets/s
    each."""
    slots_newcomer: int = 140
    """Slots for which a robot is a newcomer. Without slots for them, 50 robots need 18 s instead of 9 to get in from
    cold at 14 ms a slot, and a robot between two full cells may be heard by nobody for a minute. 70 slots take two
    seconds longer, 210 no less."""
    slots_newcomer_frames: int = 8
    """The same in a small cell, in frames, as they are without newcomers."""
    slots_late_s: float = 0.01
    """s by which a host may be late at most for a packet to be sent all the same, and a slot."""
    slots_late: float = 1 / 16
    """The same in slots, where these are long: what composes far ahead has room for it. With ``slots_late_s`` alone,
    two hosts that are up to 30 ms late lose slots of .78 s that they have announced, and each has a message of the
    other after 15.6 s instead of 9.8 (median)."""
    slots_eased: float = 0.97
    """What v, see :mod:`gr_ros2.mac.slots`, is multiplied by in a free slot."""
    slots_vain: float = 4
    """What v is multiplied by after an entry in vain. With 2, v stays near 2 while 50 robots enter from cold, most
    entries collide, and it takes 10 instead of 7.5 s on average; with 3 to 8 it is the same."""
    slots_first_rate: float = 4.0
    """v at the start. With 3 or 2 it is the same."""
    slots_named_rate: float = 2.0
    """v of one that is named, and has no slots. With 4, the first message of two robots with a key comes after 15.7 s
    where packets take half a second (``bench first``); with 1, the ends of a line of three, which do not hear each
    other, begin at once, and one that comes back gets a message too late for a deadline of 4 s in 4 of 14 starts, as in
    one with 2."""
    slots_entry_rate: float = 4.0
    """v after an entry. With 8, a grid of 5 × 4 is 3 % older."""
    slots_deaf_rate: float = 64.0
    """Most that v grows to where nobody is heard."""
    slots_most_rate: float = 64.0
    """Most that entries in vain make of v."""
    slots_heard: int = 210
    """Slots for which a robot that was heard counts as heard; more where robots send less than three times in them."""
    slots_lately: int = 70
    """Slots within which somebody who is there has sent; more where there are many robots."""
    slots_deaf: int = 3
    """Maps in a row of a neighbour that lack this robot, after which it may be in step with another one. With 1 a lost
    packet is enough: a fourth of the picks in a grid of 5 × 4 at 10 % loss are at random, which leaves slots empty."""
    clock_gain: float = 0.2
    """Share of a difference by which the clock of slots follows. 1 would pass on the jitter of each packet."""
    clock_first_gain: float = 0.5
    """The same while nobody agrees. Two robots that began apart by a fifth of a slot, and move towards each other,
    agree after one packet of each; by ``clock_gain`` their packets overlap at the edges for some more, where they use
    slots in turn."""
    clock_tolerance: float = 0.25
    """Slots. Sender and receiver still agree on the number of a slot, whatever the jitter within the guard."""
    clock_patience: int = 105
    """Slots for which a robot whose clock has jumped may take to notice: some packets of two others."""
    clock_memory: int = 210
    """Slots for which a robot that agreed counts as one that agrees."""
    clock_behind: int = 280
    """Slots that one that is behind may take to follow."""
    clock_stays: int = 140
    """Slots. Clearly less than ``clock_behind``: with 210 for both, the two robots of a link between two groups may
    change sides in turn for 4,000 slots (20 at random, held together by one link, are .3 s older at 14 ms a slot)."""

    # ---- limited ALOHA, by ``bench mac``

    aloha_load: float = 0.5
    """Packets that all robots together start in one airtime."""
    aloha_heard: int = 1500
    """Airtimes for which a robot counts: of 100 robots each is heard about every 600."""
    aloha_step: float = 0.25
    """Logarithm of the factor by which the interval grows for each robot in whose place nothing is heard."""
    aloha_longest: int = 300
    """Airtimes, mean interval of a robot that hears nobody."""

    # ---- the SNR that reports give, and the adaptive rate; all by ``bench rate_rules``

    snr_error: float = 1.3
    """Mean square of the error of an SNR that one preamble gives, dB^2, with a margin."""
    snr_least_share: float = 0.2
    """Share of a new packet in the smoothed SNR at least."""
    snr_most_share: float = 0.8
    """The same at most."""
    snr_smoothing: float = 0.125
    """How fast the error is learned."""
    snr_change_db: float = 1.5
    """Change of the SNR that is reported at once, dB."""
    rate_gain: float = 1.1
    """How many times the present MCS's goodput another MCS must promise to be taken."""
    rate_look_back_s: float = 0.06
    """s over which a change of the SNR is measured: long against the errors of single reports."""
    rate_error_db: float = 1.0
    """Change of the SNR within this time that may be an error of measurement, dB."""
    rate_correction_db_s: float = 3.0
    """dB of correction per s, for a loss of 1 where 0 was expected."""
    rate_forget_s: float = 2.0
    """s in which the correction falls to 1/e: the SNR is trusted again in the end. With ``rate_correction_db_s`` it
    limits the correction to 6 dB."""
    rate_gaps: float = 4.0
    """Usual times between two reports after which a robot counts as silent, if it should have reported."""
    rate_least_silent_s: float = 0.04
    """s after which a robot counts as silent at the earliest."""
    rate_most_silent_s: float = 1.0
    """s after which no report is trusted."""
    rate_unanswered: int = 12
    """Packets to a robot since its last report, from which on it should have reported."""
    rate_smoothing: float = 0.125
    """Share of what is new in the averages of the time between reports and of the rate of change."""
