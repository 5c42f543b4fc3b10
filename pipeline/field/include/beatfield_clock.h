/* beatfield_clock.h - the phase of a beating heart now, from its past R peaks, in C99 or C++11.
 *
 * In one source file of a program:
 *
 *     #define BEATFIELD_CLOCK_IMPLEMENTATION
 *     #include "beatfield_clock.h"
 *
 * and everywhere else just the #include. No library is needed but libm; nothing is allocated.
 *
 *     bf_clock clock = bf_new_clock(rr_s, 10.0 / field.fixture[0].f_max_n);  10 N/s at most
 *     (rr_s: field.rr_s, or what a beat lasts usually where that is 0, unknown)
 *     bf_beat(&clock, r_s, 0);                       whenever an R peak becomes known
 *     bf_tick now;
 *     clock.withheld = !bf_contains(&field, point_mm);  in every turn of the loop
 *     bf_now(&clock, time_s, lead_connected, &now);
 *     bf_force(&field, 0, point_mm, now.phase, force_n);
 *     for (int i = 0; i < 3; i++) force_n[i] *= now.fade;
 *
 * Times are seconds on one clock, that of the R peaks and of the loop alike; no heart has beaten before
 * it beats, so a beat that lies ahead of the time asked for is forgotten, with all before it.
 * Phases are those of one nominal beat, of the length the field was baked for: systole keeps its
 * length when the rate changes (Weissler, Harris and Schoenfeld, Circulation 37:149-159, 1968), atria
 * contract 120 ms before R, diastole gives way.
 * The phase does not jump where it is valid: it is corrected by running at half to one and a half
 * times its speed. What pipeline.registration.clock says in Python, this says with the same numbers.
 * From samples of an ECG to R peaks: pipeline.registration.rpeaks, in Python; here beats are told.
 * One clock belongs to one thread. Not for -ffast-math, which takes what is no number for one.
 */
#ifndef BEATFIELD_CLOCK_H
#define BEATFIELD_CLOCK_H

#ifdef __cplusplus
extern "C" {
#endif

#define BF_CLOCK_KEPT 16

/* Lost: no lead, no rhythm yet, or a beat is overdue. Ectopic: a beat came early or looks unlike the
 * others, and no regular interval has passed since. Fibrillating: intervals have no order. */
typedef enum { BF_LOST, BF_REGULAR, BF_ECTOPIC, BF_FIBRILLATING } bf_rhythm;

typedef enum {
    BF_NO_BEAT = -1, /* no later than the last one, or too far ahead: it does not count */
    BF_NORMAL_BEAT,
    BF_ECTOPIC_BEAT,
    BF_IRREGULAR_BEAT
} bf_beat_kind;

/* What beats have told. */
typedef struct {
    bf_rhythm rhythm;
    double last_r_s;
    double beats;
    double rr_s, spread_s; /* predicted interval, and how far predictions are off */
    int good, needed;      /* regular intervals in succession, and how many make a rhythm */
    long count;
    int gap;               /* beats may have been missed since the last one */
    double interval_s[BF_CLOCK_KEPT];
    int regular[BF_CLOCK_KEPT]; /* 1, 0, or -1 for a beat of another shape */
} bf_known;

typedef struct {
    double cycle_rr_s, fade_per_s; /* the nominal beat; share of the force faded in a second */
    double latency_s;              /* how long after its R a beat may be told: 0.14, or yours, above 0 to 1 s */
    int withheld;                  /* 0; set it while no force is wanted, as of a tool outside the grid */
    double now_s;
    int started;
    double turn_s;                 /* a usual turn of the loop */
    double phase, sd;
    int valid;
    double fade;
    bf_known known, before; /* now, and before the last beat */
} bf_clock;

typedef struct {
    double phase;     /* [0, 1) of the nominal beat, 0 at R */
    double sd;        /* its standard deviation */
    bf_rhythm rhythm;
    int valid;        /* whether the phase can be relied on */
    double fade;      /* share of the force to render, in [0, 1]: to 1 while valid and not withheld */
} bf_tick;

/* A clock that has seen nothing. fade_per_s: the fixture's force rate over its largest force. With a
 * cycle outside 0.2 to 3 s, or a rate that is not above 0 or not finite, it is never valid and its
 * fade stays 0. Of a monitor that tells beats later than 0.14 s after R, set clock.latency_s: a
 * beat that is overdue is noticed so much later (not above 0, or over 1 s: never valid, either). */
bf_clock bf_new_clock(double cycle_rr_s, double fade_per_s);

/* Go on for another field, with all that beats have told: another cycle and rate, as for bf_new_clock.
 * Set withheld and wait until fade is 0; before, or with numbers that are none, -1, and nothing changes. */
int bf_change_field(bf_clock *clock, double cycle_rr_s, double fade_per_s);

/* An R peak became known, as a rule within clock.latency_s: the clock waits no longer for one that is
 * due. strange: its shape is unlike the others'. BF_NO_BEAT when it is no later than the last, or more
 * than 3 s after the latest time told by bf_now or by a beat: so far ahead it was timed by another
 * clock, or in another unit. Nothing changes then, but that bf_take_back has no beat to take back. */
bf_beat_kind bf_beat(bf_clock *clock, double r_s, int strange);

/* The last beat was none, as a P wave that its R followed: know what was known before it. To be told
 * at once, before the beat that shows it; what was rendered since stays, and is corrected. */
void bf_take_back(bf_clock *clock);

/* Phase now; usable: some lead is connected. Where the last beat lies more than 0.02 s ahead, beats and
 * loop are timed by different clocks: all are forgotten, and the rhythm is learnt anew. Returns 0, or
 * -1 when the time is no number or lies before the last one. Up to 0.02 s before, nothing changes.
 * Otherwise the phase is not valid, beats are forgotten, the fade falls as in a millisecond, and
 * from then on time is counted from there. In one call the fade moves by 0.02 s' worth at most, and
 * while it is not 0 the phase makes up for no more than that, or three usual turns of the loop,
 * however long it was held up: a phase that is then too far off is not valid until it was faded out
 * and set. More than 1e11 s are no time. */
int bf_now(bf_clock *clock, double now_s, int usable, bf_tick *tick);

/* Phase of a beat of rr_s on the axis of a beat of cycle_rr_s. No number (which a field refuses) where
 * the phase is none, or a length not above 0 or not finite, as field.rr_s where it is unknown. */
double bf_to_cycle(double phase, double rr_s, double cycle_rr_s);

#ifdef __cplusplus
}
#endif

#endif /* BEATFIELD_CLOCK_H */

#ifdef BEATFIELD_CLOCK_IMPLEMENTATION
#undef BEATFIELD_CLOCK_IMPLEMENTATION

#include <math.h>
#include <string.h>
#if (defined(__FINITE_MATH_ONLY__) && __FINITE_MATH_ONLY__) || defined(_M_FP_FAST)
#error "beatfield_clock.h tells what is no number from what is one: compile without -ffast-math or /fp:fast"
#endif

#ifdef __cplusplus
extern "C" {
#endif

#define BFC_PI 3.14159265358979323846
#define BFC_LATENCY_S 0.14
#define BFC_SHORTEST_RR_S 0.2
#define BFC_LONGEST_RR_S 3.0
#define BFC_NEAREST_S 0.18 /* a nearer peak is no beat: a bounce, a pulse of a pacemaker or of diathermy */
#define BFC_R_SD_S 0.002
#define BFC_REGULAR 0.10
#define BFC_MOST 0.17
#define BFC_CLOSE 0.02
#define BFC_MOST_SD 0.05
#define BFC_SLOWEST 0.5
#define BFC_QUICKEST 1.5
#define BFC_IRREGULAR 0.075
#define BFC_ORDERLY 0.05
#define BFC_MOST_NEEDED 6 /* regular intervals in a row, of a rhythm that often surprised */
#define BFC_AHEAD_S 3.0
#define BFC_SLACK_S 0.02
#define BFC_TICK_S 0.001
#define BFC_HELD_UP 3.0
#define BFC_MOST_TURN_S 0.1 /* a question asked to warm up may lie long before the loop */
#define BFC_FOLLOWED 0.1
#define BFC_MOST_TIME_S 1e11

static double bfc_min(double a, double b) { return b < a ? b : a; }
static double bfc_max(double a, double b) { return b > a ? b : a; }

static int bfc_is_time(double time_s) { return fabs(time_s) <= BFC_MOST_TIME_S; }

static double bfc_systole_share(double rr_s)
{
    double rate = bfc_min(bfc_max(60.0 / rr_s, 45.0), 120.0);
    double length_s = 0.5475 - 0.00205 * rate - 0.04;
    return length_s * bfc_min(1.0, rr_s * 120.0 / 60.0) / rr_s;
}

static double bfc_kick(double rr_s) { return 1.0 - 0.12 / bfc_max(rr_s, 60.0 / 120.0); }

double bf_to_cycle(double phase, double rr_s, double cycle_rr_s)
{
    double from_end, from_kick, to_end, to_kick, a, b, sine, place;
    if (!(rr_s > 0.0 && isfinite(rr_s) && cycle_rr_s > 0.0 && isfinite(cycle_rr_s)))
        return (double)NAN;
    if (rr_s == cycle_rr_s)
        return phase;
    from_end = 1.0 / tan(BFC_PI * bfc_systole_share(rr_s));
    from_kick = 1.0 / tan(BFC_PI * bfc_kick(rr_s));
    to_end = 1.0 / tan(BFC_PI * bfc_systole_share(cycle_rr_s));
    to_kick = 1.0 / tan(BFC_PI * bfc_kick(cycle_rr_s));
    b = (to_end - to_kick) / (from_end - from_kick);
    a = to_end - b * from_end;
    sine = sin(BFC_PI * phase);
    place = atan2(sine, a * sine + b * cos(BFC_PI * phase)) / BFC_PI;
    return place >= 1.0 ? 0.0 : place;
}

static double bfc_wrapped(double turns) { return turns - floor(turns + 0.5); }

/* Know of no beat, as at the start; the time and what is rendered stay. */
static void bfc_forget(bf_clock *c)
{
    memset(c->known.interval_s, 0, sizeof c->known.interval_s);
    memset(c->known.regular, 0, sizeof c->known.regular);
    c->known.last_r_s = c->known.beats = 0.0;
    c->known.count = 0;
    c->known.rr_s = c->cycle_rr_s;
    c->known.spread_s = 0.05 * c->cycle_rr_s;
    c->known.needed = 3;
    c->before = c->known;
}

static int bfc_are_fit(double cycle_rr_s, double fade_per_s)
{
    return cycle_rr_s >= BFC_SHORTEST_RR_S && cycle_rr_s <= BFC_LONGEST_RR_S && fade_per_s > 0.0 &&
           isfinite(fade_per_s);
}

int bf_change_field(bf_clock *c, double cycle_rr_s, double fade_per_s)
{
    if (c->fade > 0.0 || !bfc_are_fit(cycle_rr_s, fade_per_s))
        return -1;
    c->cycle_rr_s = cycle_rr_s;
    c->fade_per_s = fade_per_s;
    /* So that the phase is set, not corrected, on the axis of the new cycle. */
    c->valid = 0;
    if (c->known.beats == 0.0)
        bfc_forget(c);
    return 0;
}

bf_clock bf_new_clock(double cycle_rr_s, double fade_per_s)
{
    bf_clock clock;
    memset(&clock, 0, sizeof clock);
    clock.known.rhythm = BF_LOST;
    clock.latency_s = BFC_LATENCY_S;
    if (bfc_are_fit(cycle_rr_s, fade_per_s)) {
        clock.cycle_rr_s = cycle_rr_s;
        clock.fade_per_s = fade_per_s;
    } else {
        clock.cycle_rr_s = 0.8; /* so that numbers stay numbers */
    }
    bfc_forget(&clock);
    return clock;
}

static double bfc_tolerance(const bf_clock *c)
{
    double least_s = bfc_max(BFC_REGULAR * c->known.rr_s, 3.0 * c->known.spread_s);
    return bfc_min(least_s, BFC_MOST * c->known.rr_s);
}

static int bfc_slot(const bf_clock *c, int back)
{
    return (int)((c->known.count - 1 - back + BF_CLOCK_KEPT) % BF_CLOCK_KEPT);
}

static double bfc_interval(const bf_clock *c, int back)
{
    return c->known.interval_s[bfc_slot(c, back)];
}

static int bfc_was_regular(const bf_clock *c, int back)
{
    return c->known.regular[bfc_slot(c, back)] > 0;
}

/* Whether the last three intervals agree, so that a new rate has come to stay. */
static int bfc_settled(const bf_clock *c)
{
    double low, high;
    int back;
    if (c->known.count < 3)
        return 0;
    low = high = bfc_interval(c, 0);
    for (back = 0; back < 3; back++) {
        if (c->known.regular[bfc_slot(c, back)] < 0)
            return 0;
        low = bfc_min(low, bfc_interval(c, back));
        high = bfc_max(high, bfc_interval(c, back));
    }
    return high - low <= BFC_REGULAR * high;
}

/* Whether an interval lies between two beats of the usual shape. */
static int bfc_own(const bf_clock *c, int count, int back)
{
    int before = back + 1 < count && c->known.regular[bfc_slot(c, back + 1)] < 0;
    return !before && c->known.regular[bfc_slot(c, back)] >= 0;
}

/* How many of the last intervals were not as expected, though between beats of one shape. */
static int bfc_surprises(const bf_clock *c)
{
    int count = c->known.count < BF_CLOCK_KEPT ? (int)c->known.count : BF_CLOCK_KEPT, back, found = 0;
    for (back = 0; back < count; back++)
        found += bfc_own(c, count, back) && !bfc_was_regular(c, back);
    return found;
}

/* Size that a third of the steps between intervals `lag` apart stay under. */
static double bfc_usual_step(const bf_clock *c, int count, int lag)
{
    double steps[10];
    int used = 0, i, j;
    for (i = 0; i < count - lag; i++) {
        double step = fabs(bfc_interval(c, i) - bfc_interval(c, i + lag));
        if (!bfc_own(c, count, i) || !bfc_own(c, count, i + lag))
            continue;
        for (j = used++; j > 0 && steps[j - 1] > step; j--)
            steps[j] = steps[j - 1];
        steps[j] = step;
    }
    return used < 4 ? 0.0 : steps[35 * (used - 1) / 100];
}

static double bfc_irregularity(const bf_clock *c)
{
    int count = c->known.count < 10 ? (int)c->known.count : 10, back;
    double mean = 0.0;
    if (count < 7)
        return 0.0;
    for (back = 0; back < count; back++)
        mean += bfc_interval(c, back) / count;
    return bfc_min(bfc_usual_step(c, count, 1), bfc_usual_step(c, count, 2)) / mean;
}

/* The next interval: what two before it say, by the latest regular ones (least squares). */
static void bfc_predict(bf_clock *c)
{
    int count = c->known.count < BF_CLOCK_KEPT ? (int)c->known.count : BF_CLOCK_KEPT, back;
    double mean = 0.0, used = 0.0, s11, s12 = 0.0, s22, s1y = 0.0, s2y = 0.0, one, two, step;
    for (back = 0; back < count; back++) {
        if (bfc_was_regular(c, back)) {
            mean += bfc_interval(c, back);
            used += 1.0;
        }
    }
    if (used == 0.0)
        return;
    mean /= used;
    s11 = s22 = 2.0 * (0.01 * mean) * (0.01 * mean);
    for (back = 0; back < count - 2; back++) {
        if (bfc_was_regular(c, back) && bfc_was_regular(c, back + 1) &&
            bfc_was_regular(c, back + 2)) {
            double y = bfc_interval(c, back) - mean;
            one = bfc_interval(c, back + 1) - mean;
            two = bfc_interval(c, back + 2) - mean;
            s11 += one * one;
            s12 += one * two;
            s22 += two * two;
            s1y += one * y;
            s2y += two * y;
        }
    }
    one = bfc_was_regular(c, 0) ? bfc_interval(c, 0) - mean : 0.0;
    two = count > 1 && bfc_was_regular(c, 1) ? bfc_interval(c, 1) - mean : 0.0;
    step = ((s1y * s22 - s2y * s12) * one + (s2y * s11 - s1y * s12) * two) / (s11 * s22 - s12 * s12);
    c->known.rr_s = mean + bfc_min(bfc_max(step, -0.2 * mean), 0.2 * mean);
}

/* What the rhythm is with its latest interval, and when the next beat is due; whether the last
   intervals agree (bfc_settled). */
static int bfc_judge(bf_clock *c, int regular, double off_s)
{
    int steady = bfc_settled(c), back, often;
    double share;
    if (!regular && steady) {
        for (back = 0; back < BF_CLOCK_KEPT; back++)
            c->known.regular[bfc_slot(c, back)] = back < 3;
    }
    if (regular && c->known.count > 3)
        c->known.spread_s = sqrt(0.8 * c->known.spread_s * c->known.spread_s + 0.2 * off_s * off_s);
    c->known.good = regular || steady ? c->known.good + 1 : 0;
    share = bfc_irregularity(c);
    if (share > BFC_IRREGULAR || (c->known.rhythm == BF_FIBRILLATING && share > BFC_ORDERLY)) {
        c->known.rhythm = BF_FIBRILLATING;
        c->known.needed = 3;
        c->known.good = 0;
    } else if (c->known.good >= c->known.needed) {
        c->known.rhythm = BF_REGULAR;
        c->known.needed = 1;
    } else if (!(regular || steady)) {
        c->known.rhythm = BF_ECTOPIC;
        /* Two early beats and the pauses after them are no habit. What came before a new rate counts
           as unexpected: three alike may be chance. */
        often = bfc_surprises(c) - 3;
        if (often > BFC_MOST_NEEDED)
            often = BFC_MOST_NEEDED;
        if (often > c->known.needed)
            c->known.needed = often;
    }
    if (c->known.rhythm != BF_REGULAR)
        c->valid = 0;
    bfc_predict(c);
    return steady;
}

/* The latest time that the clock was told of, by a question or by a beat. */
static double bfc_latest(const bf_clock *c)
{
    if (c->started && c->known.beats > 0.0)
        return bfc_max(c->now_s, c->known.last_r_s);
    return c->started ? c->now_s : c->known.last_r_s;
}

void bf_take_back(bf_clock *c)
{
    /* Leads that were lost since are not to be forgotten. */
    if (!c->known.gap)
        c->known = c->before;
}

bf_beat_kind bf_beat(bf_clock *c, double r_s, int strange)
{
    double rr_s, off_s;
    int known, regular, early, place, settled, learning;
    c->before = c->known;
    if (!bfc_is_time(r_s) || (c->known.beats > 0.0 && !(r_s > c->known.last_r_s)))
        return BF_NO_BEAT;
    /* The last beat counts beside the time: the next question may lie far from the last one. */
    if ((c->started || c->known.beats > 0.0) && r_s > bfc_latest(c) + BFC_AHEAD_S)
        return BF_NO_BEAT;
    rr_s = r_s - c->known.last_r_s;
    c->known.last_r_s = r_s;
    c->known.beats += 1.0;
    if (c->known.beats < 2.0 || c->known.gap) {
        c->known.gap = 0;
        return BF_NORMAL_BEAT;
    }
    if (rr_s < BFC_NEAREST_S)
        strange = 1;
    off_s = rr_s - c->known.rr_s;
    known = c->known.count >= 3;
    if (known)
        regular = fabs(off_s) <= bfc_tolerance(c);
    else
        regular = c->known.count == 0 || fabs(rr_s - bfc_interval(c, 0)) <= BFC_MOST * rr_s;
    regular = regular && !strange;
    early = strange || (known && off_s < -bfc_tolerance(c));
    place = (int)(c->known.count % BF_CLOCK_KEPT);
    c->known.interval_s[place] = rr_s;
    c->known.regular[place] = strange ? -1 : regular;
    c->known.count += 1;
    learning = c->known.needed > 1;
    settled = bfc_judge(c, regular, off_s);
    /* Told so late it was overdue, however regular: by a clock that is behind the loop's every beat is.
       The first beats come late because a detector must know what a beat looks like. */
    if (!learning && c->started && c->now_s - r_s > c->latency_s + BFC_MOST * c->known.rr_s) {
        c->known.good = 0;
        c->valid = 0;
        if (c->known.rhythm == BF_REGULAR)
            c->known.rhythm = BF_LOST;
    }
    if (c->known.rhythm == BF_FIBRILLATING)
        return BF_IRREGULAR_BEAT;
    /* The third beat of a new rate is one of its rhythm. */
    return early && !settled ? BF_ECTOPIC_BEAT : BF_NORMAL_BEAT;
}

/* Beats since the last R peak, whole ones and the phase of this one, if the interval is rr_s and the
 * next come as due. It never falls as time goes on. */
static double bfc_beats_since(const bf_clock *c, double now_s, double rr_s)
{
    double turns = (now_s - c->known.last_r_s) / rr_s, whole = floor(turns);
    double place = bf_to_cycle(turns - whole, rr_s, c->cycle_rr_s);
    /* A phase that is rounded up to the next R peak is 0 there, with one whole beat more. */
    return whole + (place == 0.0 && turns - whole > 0.5 ? 1.0 : place);
}

/* Where the heart should be, if the interval is rr_s and the next beats come as due. */
static double bfc_place(const bf_clock *c, double now_s, double rr_s)
{
    double beats = bfc_beats_since(c, now_s, rr_s);
    return beats - floor(beats);
}

/* Notice that no lead shows anything, or that a beat is overdue. */
static void bfc_watch(bf_clock *c, double now_s, int usable)
{
    double waited_s = now_s - c->known.last_r_s;
    if (!usable || c->known.beats < 1.0 || waited_s > 3.0 * c->known.rr_s) {
        c->known.rhythm = BF_LOST;
        c->known.needed = 3;
        c->known.good = 0;
        c->valid = 0;
        if (!usable || waited_s > bfc_max(3.0 * c->known.rr_s, BFC_LONGEST_RR_S))
            c->known.gap = 1;
    } else if (waited_s > c->known.rr_s + bfc_tolerance(c) + c->latency_s) {
        c->known.rhythm = c->known.rhythm == BF_REGULAR ? BF_LOST : c->known.rhythm;
        c->known.good = 0;
        c->valid = 0;
    }
}

/* Move the phase towards where the beats say, and judge it. */
static void bfc_turn(bf_clock *c, double before_s, double now_s)
{
    double rr_s = c->known.rr_s, there = bfc_beats_since(c, now_s, rr_s);
    double natural = there - bfc_beats_since(c, before_s, rr_s), place = there - floor(there);
    double off, h, by_interval, by_peak;
    if (c->fade == 0.0 && !c->valid) {
        c->phase = place;
    } else {
        double step = natural + bfc_wrapped(place - c->phase - natural);
        c->phase += bfc_min(bfc_max(step, BFC_SLOWEST * natural), BFC_QUICKEST * natural);
        c->phase -= floor(c->phase);
    }
    off = bfc_wrapped(c->phase - place);
    h = bfc_min(bfc_max(c->known.spread_s, 1e-4), 0.5 * rr_s);
    by_interval = 0.5 * c->known.spread_s / h *
                  bfc_wrapped(bfc_place(c, now_s, rr_s - h) - bfc_place(c, now_s, rr_s + h));
    by_peak = BFC_R_SD_S / rr_s;
    c->sd = sqrt(by_interval * by_interval + by_peak * by_peak + off * off);
    c->valid = c->known.rhythm == BF_REGULAR && c->known.good >= c->known.needed &&
               c->sd <= BFC_MOST_SD && (c->valid || fabs(off) <= BFC_CLOSE) && c->fade_per_s > 0.0 &&
               c->latency_s > 0.0 && c->latency_s <= 1.0;
}

/* How much of the time since the last question the phase may make up for. */
static double bfc_followed(bf_clock *c, double passed_s)
{
    double followed_s;
    if (c->turn_s == 0.0)
        c->turn_s = bfc_min(passed_s, BFC_MOST_TURN_S);
    followed_s = bfc_min(passed_s, bfc_max(BFC_SLACK_S, BFC_HELD_UP * c->turn_s));
    c->turn_s += BFC_FOLLOWED * (followed_s - c->turn_s);
    return followed_s;
}

/* A time that is none, or of another clock: what beats told of is worth nothing any more. */
static void bfc_lose_time(bf_clock *c, double now_s)
{
    if (bfc_is_time(now_s) && now_s >= c->now_s - BFC_SLACK_S)
        return;
    bfc_forget(c);
    c->known.rhythm = BF_LOST;
    c->known.good = 0;
    c->valid = 0;
    c->fade = bfc_max(c->fade - c->fade_per_s * BFC_TICK_S, 0.0);
    if (bfc_is_time(now_s))
        c->now_s = now_s;
}

int bf_now(bf_clock *c, double now_s, int usable, bf_tick *tick)
{
    int wrong = !bfc_is_time(now_s) || (c->started && now_s < c->now_s);
    if (wrong) {
        bfc_lose_time(c, now_s);
    } else {
        double passed_s = c->started ? now_s - c->now_s : 0.0;
        double reach = c->fade_per_s * bfc_min(passed_s, BFC_SLACK_S);
        double before_s = now_s - bfc_followed(c, passed_s);
        c->started = 1;
        c->now_s = now_s;
        /* Left in, it would shift the phase, and make true beats come too late. */
        if (c->known.beats > 0.0 && c->known.last_r_s > now_s + BFC_SLACK_S)
            bfc_forget(c);
        bfc_watch(c, now_s, usable);
        bfc_turn(c, before_s, now_s);
        c->fade += bfc_min(bfc_max((double)(c->valid && !c->withheld) - c->fade, -reach), reach);
    }
    if (tick) {
        tick->phase = c->phase;
        tick->sd = c->sd;
        tick->rhythm = c->known.rhythm;
        tick->valid = c->valid;
        tick->fade = c->fade;
    }
    return wrong ? -1 : 0;
}

#ifdef __cplusplus
}
#endif

#endif /* BEATFIELD_CLOCK_IMPLEMENTATION */
