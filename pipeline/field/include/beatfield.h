/* beatfield.h - ask a baked field for distance, potential and force, in C99 or C++11.
 *
 * In one source file of a program:
 *
 *     #define BEATFIELD_IMPLEMENTATION
 *     #include "beatfield.h"
 *
 * and everywhere else just the #include. That file must include this header first, for POSIX
 * systems then declare what mapping files needs. No other library is needed but libm.
 *
 *     bf_field field;
 *     if (bf_open(&field, "OUT/patient-0001/bake/field.zarr") != BF_OK) ...
 *     bf_lock(&field);                              values in memory, before the loop starts
 *     int guide = bf_fixture(&field, "epicardium_guidance");
 *     double force_n[3];
 *     bf_force(&field, guide, point_mm, phase, force_n);      as often as you like
 *     bf_close(&field);
 *
 * Points are (x, y, z) millimetres in the patient's LPS frame of the MR, phases are shares of the
 * heartbeat since the R peak (any number; its fraction counts), transforms are row-major 4x4 on
 * column points. Distances are negative inside. A query allocates nothing and calls no system
 * function, so it is safe in a real-time loop and from several threads at once. Where it fails, its
 * answers are zeros. Forces and torques are in the frame of the MR, as points are: a device in the
 * tracker's frame gets them by bf_turn_back(field.mr_from_tracker, force_n, ...).
 *
 * Not for -ffast-math, which takes what is no number for one, nor for a big-endian processor. An open
 * field must not be copied, opened again or closed while a thread asks it. Replace a store whole, by
 * renaming: until bf_lock has copied it, a file that shrinks ends the program (SIGBUS).
 *
 * The distance between nodes and phases is the quadratic B-spline whose coefficients the store
 * holds under spline/: neither its gradient nor its rate has a step anywhere. Potential and force
 * are f(q) = 1 - exp(-(q^2 / (2 delta^2))^m) and -f_max f(q) grad q, with q the distance (guidance)
 * or the depth of penetration (forbidden region) and a gradient of unit length, except near the
 * medial axis, where the force passes through zero without a step.
 */
#ifndef BEATFIELD_H
#define BEATFIELD_H

/* Only where nothing but standard C is declared otherwise: it would take other declarations away. */
#if defined(BEATFIELD_IMPLEMENTATION) && defined(__STRICT_ANSI__) && !defined(_WIN32) && \
    !defined(_POSIX_C_SOURCE) && !defined(__cplusplus)
#define _POSIX_C_SOURCE 200809L
#endif

#include <stddef.h>

#ifdef __cplusplus
extern "C" {
#endif

#define BF_NAME 64   /* longest name of a structure or fixture, with its end */
#define BF_SCRATCH 4 /* numbers a question that a batch wants as scratch room */

typedef enum {
    BF_OK = 0,
    BF_CANNOT_READ,  /* a file is missing, or may not be read */
    BF_NOT_A_FIELD,  /* no manifest, or a description that is not that of a field */
    BF_WRONG_SIZE,   /* a file's size is not what the description says; or a batch's or tool's is none */
    BF_DAMAGED,      /* a file is not what the manifest says, or a value in it is not finite */
    BF_NO_MEMORY,    /* malloc or mmap refused */
    BF_CANNOT_LOCK,  /* mlock refused (ulimit -l), or Windows; pages are in memory, but may be paged out */
    BF_NO_SUCH_NAME, /* number of a structure or fixture that is not there */
    BF_NOT_FINITE,   /* a coordinate or phase is not a number, infinite, or too large to add up */
    BF_NOT_RIGID,    /* mr_from_tool is no rotation and shift */
    BF_WRONG_BOUND,  /* bound_n is not above 0, or not finite */
    BF_REPLACED      /* the store was replaced while it was opened: open it again */
} bf_status;

typedef struct {
    char name[BF_NAME];
    const float **coefficients; /* one array a phase, (z, y, x) */
} bf_structure_part;

typedef struct {
    char name[BF_NAME];
    int structure;   /* number of the surface that acts */
    int side;        /* 0 guidance, +1 outside forbidden, -1 inside forbidden */
    int m;           /* sharpness */
    double delta_mm; /* width */
    double f_max_n;  /* largest force */
    double device_force_n; /* what its device renders at most, whatever fixtures add up to; 0: unknown */
} bf_fixture_part;

typedef struct {
    int shape[3]; /* nodes along x, y, z */
    double origin_mm[3], spacing_mm[3];
    double per_mm[3]; /* nodes a millimetre */
    int phases;
    double *phase;       /* stored phases, rising in [0, 1) */
    double *line;        /* four numbers a phase: where which weights hold */
    double rr_s;         /* heartbeat when the images were taken; 0 where unknown */
    char patient_id[BF_NAME]; /* whose field it is; its beginning where longer, empty where not told */
    int doubts;          /* how many sentences on what speaks against it `beatfield verify` prints; -1: not told */
    int registered;      /* whether mr_from_tracker is known */
    double mr_from_tracker[16]; /* where it is not known: not numbers, so that no question succeeds */
    int structures, fixtures;
    bf_structure_part *structure;
    bf_fixture_part *fixture;
    size_t bytes; /* of one phase of one array */
    int wide;     /* whether the processor reads four nodes at a time */
    int copied;   /* whether values are a copy of the files */
} bf_field;

/* What a status means, in a few words. */
const char *bf_text(bf_status status);

/* Map a field.zarr into memory; of what the field was before, nothing is given back. On failure the
 * field is as bf_close leaves it. */
bf_status bf_open(bf_field *field, const char *path);

/* Compare every file of a field.zarr with its manifest, and that with its own digest (reads all of it;
 * not for the loop). */
bf_status bf_verify(const char *path);

/* Copy all values from the files into memory and keep them there: whatever becomes of the files after
 * that changes nothing. Where it fails with BF_CANNOT_LOCK, as always on Windows, they are copied all
 * the same; with BF_DAMAGED one is not finite, and a hand would feel a hole; of a field that is not open
 * it is BF_NOT_A_FIELD. Before the first question: it must not run while a thread asks. */
bf_status bf_lock(bf_field *field);

/* Give everything back; harmless twice. No thread may be asking any more. */
void bf_close(bf_field *field);

/* Number of a structure or fixture by name; -1 where there is none. */
int bf_structure(const bf_field *field, const char *name);
int bf_fixture(const bf_field *field, const char *name);

/* Whether a point lies in the grid. What lies outside is answered for the nearest point of the grid's
 * boundary, and says less the farther out it is. A field that is not open contains none. */
int bf_contains(const bf_field *field, const double point_mm[3]);

/* Signed distance in mm and its gradient in the frame of the MR; either may be NULL. */
bf_status bf_distance(const bf_field *field, int structure, const double point_mm[3], double phase,
                      double *distance_mm, double gradient[3]);

/* The same at many points, (count, 3) numbers; phases has one number, or count of them. Gradients may
 * be NULL, distances not; scratch may be NULL. With room for BF_SCRATCH numbers a question there,
 * questions that are many, and neither whose places nor whose phases follow one another, are answered
 * in an order of its own, several times as fast; the answers are the same. Answers may not lie where
 * the questions do. */
bf_status bf_distances(const bf_field *field, int structure, size_t count, const double *points_mm,
                       const double *phases, size_t phase_count, double *distances_mm,
                       double *gradients, double *scratch);

/* Potential of a fixture, 0 to 1. */
bf_status bf_potential(const bf_field *field, int fixture, const double point_mm[3], double phase,
                       double *potential);

/* Force of a fixture on a tool's point, newtons, in the frame of the MR. */
bf_status bf_force(const bf_field *field, int fixture, const double point_mm[3], double phase,
                   double force_n[3]);

/* Forces at many points, (count, 3) numbers each; otherwise as bf_distances. Where one cannot be
 * answered, all are zeros. */
bf_status bf_forces(const bf_field *field, int fixture, size_t count, const double *points_mm,
                    const double *phases, size_t phase_count, double *forces_n, double *scratch);

/* A rigid tool: straight pieces through points of its own frame, from the first to the last, and
 * back to the first where it is closed. */
typedef struct {
    const double *points_mm; /* (count, 3) numbers */
    int count;               /* 1 makes a tool that is a point */
    int closed;
    double handle_mm[3]; /* where the hand holds it: torque is about this point */
} bf_tool;

/* Force on a whole tool, newtons, and torque about its handle, newton-millimetres (may be NULL), both
 * in the frame of the MR: the mean of the field's force over the tool's length, so no tool feels more
 * than f_max. Stretches are divided where the field demands it, until dividing them once more would change
 * the force by less than bound_n; evaluations (may be NULL) says how often the field was asked.
 * mr_from_tool is a rotation and a shift, within 1e-3, row after row; the last row is 0 0 0 1. A tool
 * longer than 20 times the grid's diagonal, as one in micrometres, is refused: BF_WRONG_SIZE. How long
 * an answer takes grows with the tool's length in the field's reach and its number of points, and as
 * bound_n becomes less. */
bf_status bf_tool_force(const bf_field *field, int fixture, const bf_tool *tool,
                        const double mr_from_tool[16], double phase, double bound_n,
                        double force_n[3], double torque_nmm[3], int *evaluations);

/* Share of a tool's length that lies outside the grid, 0 to 1, where bf_tool_force is answered by the
 * grid's boundary: the more there is, the less the force tells. 1 where there is no telling, as by a pose that
 * bf_tool_force refuses. */
double bf_outside_share(const bf_field *field, const bf_tool *tool, const double mr_from_tool[16]);

/* A moving fixture can push energy into the hand. A tank lets through only what it holds: energy
 * that the hand gives fills it, energy that the hand gets drains it, and where it is empty the part
 * of the force that would drive the motion on is withheld. What one tick's step takes where the motion
 * begins or turns cannot be foreseen; it is owed. Off unless it is used:
 *
 *     bf_tank tank = bf_full_tank(5, 20);               5 mJ to begin with, 20 mJ at most
 *     each tick: bf_force(...); fade, clip to the device's force; bf_pass(&tank, point_mm, force_n);
 *
 * Below a tenth of its capacity, or what twelve ticks would take, a force that drives is lessened by
 * degrees, all of it, as the level falls, and comes back by degrees, so that the hand feels no step: in 1,000 ticks a second within 0.02 s and 0.2 s
 * (where the tank holds what twelve ticks take, and the motion is steady).
 * It counts what it passes, so that must be what the hand gets: whatever else is done to the force is
 * done before. Of a tool point_mm is where the hand holds it; what a torque does is not counted.
 */
typedef struct {
    double level_mj, capacity_mj;
    double point_mm[3], force_n[3]; /* of the last tick whose point was known */
    double withheld;                /* share of the force, 0 to 1 */
    int started, blind, driving;    /* driving: the force went with the motion when the tool last moved */
} bf_tank;

/* A tank that holds level_mj to begin with, and capacity_mj at most; what is no finite number, or
 * less than nothing, is 0: such a tank lets nothing pass that drives on. */
bf_tank bf_full_tank(double level_mj, double capacity_mj);

/* What may be rendered of a force, in place, at the tool's present point. Where a number of one of them
 * is not finite, or beyond 1e100, nothing may. */
void bf_pass(bf_tank *tank, const double point_mm[3], double force_n[3]);

/* target = transform * point; the arrays may be the same. */
void bf_transform(const double transform[16], const double point_mm[3], double moved_mm[3]);

/* A direction, such as a force, in the target's frame as it is in the source's: turned back, not
 * shifted. The arrays may be the same. Zeros where something is not finite, as an unknown transform; at
 * its shift nobody looks. */
void bf_turn_back(const double transform[16], const double vector[3], double turned[3]);

/* Parse the text of a store's zarr.json; bf_open does it, this is for tests. */
bf_status bf_describe(bf_field *field, const char *text, size_t length);

#ifdef __cplusplus
}
#endif
#endif /* BEATFIELD_H */

#ifdef BEATFIELD_IMPLEMENTATION
#undef BEATFIELD_IMPLEMENTATION
#if (defined(__FINITE_MATH_ONLY__) && __FINITE_MATH_ONLY__) || defined(_M_FP_FAST)
#error "beatfield.h tells what is no number from what is one: compile without -ffast-math or /fp:fast"
#endif
#if defined(__BYTE_ORDER__) && __BYTE_ORDER__ != __ORDER_LITTLE_ENDIAN__
#error "beatfield.h reads stores as they are, which are little-endian"
#endif
#include <errno.h>
#include <math.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#ifndef _WIN32
#include <fcntl.h>
#include <sys/mman.h>
#include <unistd.h>
#ifndef O_DIRECTORY
#error "include beatfield.h before other headers where it is implemented, or define _POSIX_C_SOURCE 200809L"
#endif
/* Memory of no file, in whole pages; POSIX before 2024 does not tell its name. */
#if defined(MAP_ANONYMOUS)
#define BF__ANONYMOUS MAP_ANONYMOUS
#elif defined(MAP_ANON)
#define BF__ANONYMOUS MAP_ANON
#elif defined(__linux__)
#define BF__ANONYMOUS 0x20
#else
#define BF__ANONYMOUS 0x1000
#endif
#endif
/* Where the compiler can make code for a processor that it only may meet, four nodes of a row are
 * read at a time if the processor can; BEATFIELD_PLAIN leaves that out, and so does GCC for Windows: the
 * stack is aligned to 16 bytes there, and it writes as if it were to 32 (GCC bug 54412). */
#if defined(__GNUC__) && defined(__x86_64__) && !defined(BEATFIELD_PLAIN) && \
    (!defined(_WIN32) || defined(__clang__))
#define BF__WIDE __attribute__((target("avx2,fma")))
#include <immintrin.h>
#endif
/* Part of whoever calls it, so that it is made for the caller's processor. */
#ifdef __GNUC__
#define BF__INLINE __attribute__((always_inline)) static inline
#else
#define BF__INLINE static
#endif

/* Whether a value is a number, and not infinite: told by its bits, for a compiler that may reorder sums
 * (-funsafe-math-optimizations) takes x - x for 0 whatever x is. */
BF__INLINE int bf__numeric(double value)
{
    uint64_t bits;
    memcpy(&bits, &value, sizeof bits);
    return (bits >> 52 & 0x7ff) != 0x7ff;
}

const char *bf_text(bf_status status)
{
    switch (status) {
    case BF_OK: return "done";
    case BF_CANNOT_READ: return "a file is missing or cannot be read";
    case BF_NOT_A_FIELD: return "no complete field, or of another version: give the field.zarr that bake wrote, or bake it again";
    case BF_WRONG_SIZE: return "a size is wrong: a file's (bake it again), or a batch's or tool's (mend the call)";
    case BF_DAMAGED:
        return "a file is not what the manifest says, or a value is not finite: bake it again";
    case BF_NO_MEMORY: return "no memory";
    case BF_CANNOT_LOCK: return "pages cannot be locked: raise the limit (ulimit -l)";
    case BF_NO_SUCH_NAME: return "no such structure or fixture";
    case BF_NOT_FINITE: return "a coordinate or phase is not finite";
    case BF_NOT_RIGID: return "mr_from_tool is no rotation and shift within 1e-3, row after row";
    case BF_WRONG_BOUND: return "bound_n must be above 0, and finite";
    case BF_REPLACED: return "the store was replaced while it was opened: open it again";
    }
    return "unknown status";
}

/* ---- JSON, as far as needed: a cursor over a text; nothing is copied ---- */

typedef struct {
    const char *at, *end;
    int bad; /* once set, the cursor stays where it is */
} bf__json;

enum { BF__DEPTH = 64, BF__POWER = 1000 };

static void bf__blank(bf__json *j)
{
    while (j->at < j->end && (*j->at == ' ' || *j->at == '\n' || *j->at == '\r' || *j->at == '\t'))
        j->at++;
}

/* Step over a character if it is next. */
static int bf__take(bf__json *j, char wanted)
{
    bf__blank(j);
    if (j->bad || j->at >= j->end || *j->at != wanted) return 0;
    j->at++;
    return 1;
}

static void bf__need(bf__json *j, char wanted)
{
    if (!bf__take(j, wanted)) j->bad = 1;
}

/* A string without its quotes; escapes are left as they are, for no name of ours has one. */
static void bf__string(bf__json *j, const char **start, size_t *length)
{
    *start = j->end;
    *length = 0;
    bf__need(j, '"');
    if (j->bad) return;
    *start = j->at;
    while (j->at < j->end && *j->at != '"') {
        if (*j->at == '\\' && j->at + 1 < j->end) j->at++;
        j->at++;
    }
    if (j->at >= j->end) {
        j->bad = 1;
        return;
    }
    *length = (size_t)(j->at - *start);
    j->at++;
}

/* A number, whatever the program's locale says of decimal points. Where long double has 64 bits of mantissa, as on
 * x86, 19 digits and powers of ten up to 27 are exact, and so are nearly all numbers of 17 digits in double; elsewhere
 * they are rounded to a few 1e-16 of their size, from 1e-290 to 1e290. */
static double bf__number(bf__json *j)
{
    long double value = 0, scale = 1;
    int negative, digits = 0, shift = 0, power = 0, down;
    bf__blank(j);
    if (j->bad) return 0;
    negative = j->at < j->end && *j->at == '-';
    if (negative) j->at++;
    for (; j->at < j->end && *j->at >= '0' && *j->at <= '9'; j->at++, digits = 1) {
        if (value < 1e18L) value = 10 * value + (*j->at - '0');
        else if (shift < BF__POWER) shift++;
    }
    if (j->at < j->end && *j->at == '.') {
        for (j->at++; j->at < j->end && *j->at >= '0' && *j->at <= '9'; j->at++, digits = 1) {
            if (value < 1e18L && shift > -BF__POWER) {
                value = 10 * value + (*j->at - '0');
                shift--;
            }
        }
    }
    if (digits && j->at < j->end && (*j->at == 'e' || *j->at == 'E')) {
        j->at++;
        down = j->at < j->end && *j->at == '-';
        if (j->at < j->end && (*j->at == '-' || *j->at == '+')) j->at++;
        for (digits = 0; j->at < j->end && *j->at >= '0' && *j->at <= '9'; j->at++, digits = 1)
            if (power < BF__POWER) power = 10 * power + (*j->at - '0');
        shift += down ? -power : power;
    }
    if (!digits) j->bad = 1;
    if (value > 0) {
        for (power = shift < 0 ? -shift : shift; power > 0; power--) scale *= 10;
        value = shift < 0 ? value / scale : value * scale;
    }
    return (double)(negative ? -value : value);
}

static void bf__skip(bf__json *j, int depth)
{
    const char *text;
    size_t length;
    char close;
    bf__blank(j);
    if (j->bad || j->at >= j->end || depth > BF__DEPTH) {
        j->bad = 1;
        return;
    }
    if (*j->at == '"') {
        bf__string(j, &text, &length);
    } else if (*j->at == '{' || *j->at == '[') {
        close = *j->at == '{' ? '}' : ']';
        j->at++;
        if (bf__take(j, close)) return;
        do {
            if (close == '}') {
                bf__string(j, &text, &length);
                bf__need(j, ':');
            }
            bf__skip(j, depth + 1);
        } while (bf__take(j, ','));
        bf__need(j, close);
    } else if ((*j->at >= '0' && *j->at <= '9') || *j->at == '-') {
        bf__number(j);
    } else {
        for (length = 0; j->at < j->end && *j->at >= 'a' && *j->at <= 'z'; j->at++) length++;
        /* true, false, null */
        if (length < 4 || length > 5) j->bad = 1;
    }
}

/* Go through an object: 1 and the next key, with the cursor at its value; 0 behind its end. */
static int bf__key(bf__json *j, int *first, const char **key, size_t *length)
{
    if (*first) {
        bf__need(j, '{');
        *first = 0;
        if (bf__take(j, '}')) return 0;
    } else if (!bf__take(j, ',')) {
        bf__need(j, '}');
        return 0;
    }
    bf__string(j, key, length);
    bf__need(j, ':');
    return !j->bad;
}

/* The same for an array: 1 with the cursor at the next value. */
static int bf__item(bf__json *j, int *first)
{
    if (*first) {
        bf__need(j, '[');
        *first = 0;
        return !bf__take(j, ']') && !j->bad;
    }
    if (bf__take(j, ',')) return 1;
    bf__need(j, ']');
    return 0;
}

static int bf__is(const char *key, size_t length, const char *name)
{
    return strlen(name) == length && memcmp(key, name, length) == 0;
}

static int bf__null(bf__json *j)
{
    bf__blank(j);
    if (j->bad || j->end - j->at < 4 || memcmp(j->at, "null", 4) != 0) return 0;
    j->at += 4;
    return 1;
}

/* Numbers of an array into values, room for capacity of them; how many there were. */
static int bf__numbers(bf__json *j, double *values, int capacity)
{
    int first = 1, count = 0;
    while (bf__item(j, &first)) {
        double value = bf__number(j);
        if (count >= capacity) {
            j->bad = 1;
            return count;
        }
        values[count++] = value;
    }
    return count;
}

static void bf__name(bf__json *j, const char *start, size_t length, char name[BF_NAME])
{
    size_t n;
    if (length == 0 || length >= BF_NAME) {
        j->bad = 1;
        length = 0;
    }
    for (n = 0; n < length; n++) {
        char c = start[n];
        if (!((c >= 'a' && c <= 'z') || (c >= 'A' && c <= 'Z') || (c >= '0' && c <= '9') ||
              (n && (c == '_' || c == '-'))))
            j->bad = 1;
    }
    memcpy(name, start, length);
    name[length] = 0;
}

/* How many entries an object at the cursor has; the cursor stays. */
static int bf__entries(bf__json j)
{
    const char *key;
    size_t length;
    int first = 1, count = 0;
    while (bf__key(&j, &first, &key, &length)) {
        bf__skip(&j, 0);
        count++;
    }
    return j.bad ? 0 : count;
}

/* ---- what a store says of itself ---- */

enum { BF__MOST_PHASES = 4096, BF__MOST_PARTS = 1024 };

/* Whether a 4x4 is a rotation and a shift, within 1e-3. */
static int bf__rigid(const double t[16])
{
    double det, shift = t[3] + t[7] + t[11];
    int a, b;
    if (!(fabs(t[12]) + fabs(t[13]) + fabs(t[14]) + fabs(t[15] - 1) <= 1e-6)) return 0;
    if (!bf__numeric(shift)) return 0;
    for (a = 0; a < 12; a += 4)
        for (b = 0; b < 12; b += 4) {
            double dot = t[a] * t[b] + t[a + 1] * t[b + 1] + t[a + 2] * t[b + 2];
            if (!(fabs(dot - (a == b)) <= 1e-3)) return 0;
        }
    det = t[0] * (t[5] * t[10] - t[6] * t[9]) + t[1] * (t[6] * t[8] - t[4] * t[10]) +
          t[2] * (t[4] * t[9] - t[5] * t[8]);
    return det > 0;
}

/* Whether a text at the cursor is the one that is wanted. */
static int bf__says(bf__json *j, const char *wanted)
{
    const char *text;
    size_t length;
    bf__string(j, &text, &length);
    return !j->bad && bf__is(text, length, wanted);
}

static void bf__grid(bf__json *j, bf_field *field)
{
    const char *key;
    size_t length;
    double shape[3] = {0, 0, 0};
    int first = 1, axis, found = 0;
    while (bf__key(j, &first, &key, &length)) {
        if (bf__is(key, length, "shape_zyx")) found += bf__numbers(j, shape, 3);
        else if (bf__is(key, length, "origin_mm")) found += bf__numbers(j, field->origin_mm, 3);
        else if (bf__is(key, length, "spacing_mm")) found += bf__numbers(j, field->spacing_mm, 3);
        else bf__skip(j, 0);
    }
    for (axis = 0; axis < 3; axis++) {
        if (!(shape[2 - axis] >= 2 && shape[2 - axis] <= 65536) || shape[2 - axis] != floor(shape[2 - axis]))
            j->bad = 1;
        else field->shape[axis] = (int)shape[2 - axis];
        if (!(field->spacing_mm[axis] > 1e-6 && field->spacing_mm[axis] < 1e6)) j->bad = 1;
        if (!(fabs(field->origin_mm[axis]) < 1e9)) j->bad = 1;
    }
    /* Its bytes must be countable, with 32 bits too. */
    if (found != 9 || shape[0] * shape[1] * shape[2] > (double)(((size_t)-1) / 8)) j->bad = 1;
}

/* What queries need of the grid and of the processor. */
static void bf__scale(bf_field *field)
{
    int axis;
    for (axis = 0; axis < 3; axis++) field->per_mm[axis] = 1 / field->spacing_mm[axis];
#ifdef BF__WIDE
    field->wide = field->shape[0] >= 4 && __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma");
#endif
}

static void bf__phases(bf__json *j, bf_field *field)
{
    double *values = (double *)malloc(BF__MOST_PHASES * sizeof(double));
    int count, k;
    if (!values) {
        j->bad = 1;
        return;
    }
    count = bf__numbers(j, values, BF__MOST_PHASES);
    for (k = 0; k < count; k++)
        if (!(values[k] >= 0 && values[k] < 1 && (k == 0 || values[k] > values[k - 1]))) j->bad = 1;
    if (count < 1 || field->phase) j->bad = 1;
    if (j->bad) {
        free(values);
        return;
    }
    field->phases = count;
    field->phase = values;
}

static void bf__transform(bf__json *j, bf_field *field)
{
    int first = 1, row = 0;
    if (bf__null(j)) return;
    while (bf__item(j, &first)) {
        if (row >= 4 || bf__numbers(j, field->mr_from_tracker + 4 * row, 4) != 4) {
            j->bad = 1;
            return;
        }
        row++;
    }
    field->registered = row == 4;
    if (row != 4 || !bf__rigid(field->mr_from_tracker)) j->bad = 1;
}

static void bf__structures(bf__json *j, bf_field *field)
{
    const char *key;
    size_t length;
    int first = 1, count = bf__entries(*j);
    if (count < 1 || count > BF__MOST_PARTS || field->structure) {
        j->bad = 1;
        return;
    }
    field->structure = (bf_structure_part *)calloc((size_t)count, sizeof(bf_structure_part));
    if (!field->structure) {
        j->bad = 1;
        return;
    }
    while (bf__key(j, &first, &key, &length) && field->structures < count) {
        bf__name(j, key, length, field->structure[field->structures++].name);
        bf__skip(j, 0);
    }
}

/* The steepest slope of a fixture's force over distance, N/m. */
static double bf__stiffness(double f_max_n, double delta_mm, double m)
{
    /* f' is largest where (q^2 / (2 delta^2))^m is 1 - 1 / (2 m). */
    double u = 1 - 0.5 / m;
    return 1000 * f_max_n / delta_mm * sqrt(2.0) * m * pow(u, u) * exp(-u);
}

/* A fixture names its structure; the names are matched when all is read. */
static void bf__fixture(bf__json *j, bf_fixture_part *part, const char **structure, size_t *size)
{
    const char *key, *text;
    size_t length, span;
    double m = 0, stiffest = 0;
    int first = 1, inner, limited = 0, forbidden = -1;
    while (bf__key(j, &first, &key, &length)) {
        if (bf__is(key, length, "kind")) {
            bf__string(j, &text, &span);
            forbidden = bf__is(text, span, "forbidden_region");
            if (!forbidden && !bf__is(text, span, "guidance")) j->bad = 1;
        } else if (bf__is(key, length, "device_limits")) {
            for (inner = 1; bf__key(j, &inner, &key, &length);) {
                if (bf__is(key, length, "force_n")) {
                    part->device_force_n = bf__number(j);
                    limited = 1;
                } else if (bf__is(key, length, "stiffness_n_per_m") && !bf__null(j)) {
                    stiffest = bf__number(j);
                    if (!(stiffest > 0)) j->bad = 1;
                } else if (!bf__is(key, length, "stiffness_n_per_m")) bf__skip(j, 0);
            }
        } else if (bf__is(key, length, "structure")) bf__string(j, structure, size);
        else if (bf__is(key, length, "delta_mm")) part->delta_mm = bf__number(j);
        else if (bf__is(key, length, "f_max_n")) part->f_max_n = bf__number(j);
        else if (bf__is(key, length, "m")) m = bf__number(j);
        else if (bf__is(key, length, "side") && !bf__null(j)) {
            bf__string(j, &text, &span);
            part->side = bf__is(text, span, "outside") ? 1 : -1;
            if (part->side < 0 && !bf__is(text, span, "inside")) j->bad = 1;
        } else if (!bf__is(key, length, "side")) bf__skip(j, 0);
    }
    if (!(m >= 1 && m <= 20) || m != floor(m) || !(part->delta_mm > 0 && part->delta_mm < 1e9) ||
        !(part->f_max_n > 0 && part->f_max_n < 1e9) || forbidden != (part->side != 0) ||
        (limited && !(part->f_max_n <= part->device_force_n * (1 + 1e-9))) ||
        (stiffest > 0 &&
         !(bf__stiffness(part->f_max_n, part->delta_mm, m) <= stiffest * (1 + 1e-9))))
        j->bad = 1;
    else part->m = (int)m;
}

static void bf__fixtures(bf__json *j, bf_field *field, bf__json described)
{
    const char *key, *structure;
    size_t length, size;
    int first = 1, n, count = bf__entries(*j);
    bf_field named = *field;
    if (count < 1 || count > BF__MOST_PARTS || field->fixture) {
        j->bad = 1;
        return;
    }
    /* Structures may stand behind the fixtures in the text. */
    if (!field->structure) bf__structures(&described, &named);
    field->structure = named.structure;
    field->structures = named.structures;
    field->fixture = (bf_fixture_part *)calloc((size_t)count, sizeof(bf_fixture_part));
    if (!field->fixture || described.bad) {
        j->bad = 1;
        return;
    }
    while (bf__key(j, &first, &key, &length) && field->fixtures < count) {
        bf_fixture_part *part = &field->fixture[field->fixtures++];
        bf__name(j, key, length, part->name);
        structure = NULL;
        size = 0;
        bf__fixture(j, part, &structure, &size);
        part->structure = -1;
        for (n = 0; structure && n < field->structures; n++)
            if (bf__is(structure, size, field->structure[n].name)) part->structure = n;
        if (part->structure < 0) j->bad = 1;
    }
}

/* Weights in time: for each phase start, end, early and late of the interval about it. */
static bf_status bf__timeline(bf_field *field)
{
    int k, count = field->phases;
    const double *p = field->phase;
    field->line = (double *)malloc(4 * (size_t)count * sizeof(double));
    if (!field->line) return BF_NO_MEMORY;
    for (k = 0; k < count; k++) {
        double *line = field->line + 4 * k;
        double knot[4];
        int n;
        for (n = 0; n < 4; n++) {
            /* Knot n lies between phases k + n - 2 and k + n - 1, the cycle repeated. */
            int low = k + n - 2, high = k + n - 1;
            double turns_low = floor((double)low / count), turns_high = floor((double)high / count);
            knot[n] = (p[low - (int)turns_low * count] + turns_low +
                       p[high - (int)turns_high * count] + turns_high) / 2;
        }
        line[0] = knot[1];
        line[1] = knot[2];
        line[2] = 1 / ((knot[2] - knot[1]) * (knot[2] - knot[0]));
        line[3] = 1 / ((knot[2] - knot[1]) * (knot[3] - knot[1]));
    }
    return BF_OK;
}

/* Find a key of the object at the cursor and put the cursor at its value. */
static int bf__find(bf__json *j, const char *name)
{
    const char *key;
    size_t length;
    int first = 1;
    while (bf__key(j, &first, &key, &length)) {
        if (bf__is(key, length, name)) return 1;
        bf__skip(j, 0);
    }
    return 0;
}

static void bf__source(bf__json *j, bf_field *field)
{
    const char *key, *text;
    size_t length;
    int first = 1;
    while (bf__key(j, &first, &key, &length)) {
        int one = 1, told = bf__is(key, length, "doubts");
        bf__blank(j);
        if (told) field->doubts = -1;
        if (told && j->at < j->end && *j->at == '[') {
            for (field->doubts = 0; bf__item(j, &one); field->doubts++) bf__skip(j, 0);
            continue;
        }
        if (!bf__is(key, length, "patient_id") || j->at >= j->end || *j->at != '"') {
            bf__skip(j, 0);
            continue;
        }
        bf__string(j, &text, &length);
        if (j->bad) return;
        if (length > BF_NAME - 1) length = BF_NAME - 1;
        memcpy(field->patient_id, text, length);
        field->patient_id[length] = 0;
    }
}

bf_status bf_describe(bf_field *field, const char *text, size_t length)
{
    bf__json j, parts;
    const char *key;
    size_t span;
    int first = 1, version = 0, gridded = 0, n;
    bf_status status;
    memset(field, 0, sizeof *field);
    for (n = 0; n < 16; n++) field->mr_from_tracker[n] = NAN;
    field->doubts = -1;
    j.at = text;
    j.end = text + length;
    j.bad = 0;
    if (!bf__find(&j, "attributes") || !bf__find(&j, "beatfield")) return BF_NOT_A_FIELD;
    parts = j;
    if (!bf__find(&parts, "structures")) return BF_NOT_A_FIELD;
    while (bf__key(&j, &first, &key, &span)) {
        if (bf__is(key, span, "format_version")) version = bf__number(&j) == 1.0;
        else if (bf__is(key, span, "phases")) bf__phases(&j, field);
        else if (bf__is(key, span, "rr_s")) {
            int known = !bf__null(&j);
            field->rr_s = known ? bf__number(&j) : 0;
            j.bad |= known && !(field->rr_s > 0 && bf__numeric(field->rr_s));
        } else if (bf__is(key, span, "frame")) j.bad |= !bf__says(&j, "LPS");
        else if (bf__is(key, span, "unit")) j.bad |= !bf__says(&j, "mm");
        else if (bf__is(key, span, "periodic")) {
            bf__blank(&j);
            j.bad |= j.end - j.at < 4 || memcmp(j.at, "true", 4) != 0;
            bf__skip(&j, 0);
        }
        else if (bf__is(key, span, "source")) bf__source(&j, field);
        else if (bf__is(key, span, "mr_from_tracker")) bf__transform(&j, field);
        else if (bf__is(key, span, "grid")) {
            bf__grid(&j, field);
            gridded++;
        } else if (bf__is(key, span, "structures") && !field->structure) bf__structures(&j, field);
        else if (bf__is(key, span, "fixtures")) bf__fixtures(&j, field, parts);
        else bf__skip(&j, 0);
    }
    if (j.bad || version != 1 || gridded != 1 || !field->phase || !field->structure ||
        !field->fixture) {
        bf_close(field);
        return BF_NOT_A_FIELD;
    }
    field->bytes = sizeof(float) * (size_t)field->shape[0] * (size_t)field->shape[1] *
                   (size_t)field->shape[2];
    bf__scale(field);
    status = bf__timeline(field);
    if (status != BF_OK) bf_close(field);
    return status;
}

/* ---- SHA-256 (FIPS 180-4) ---- */

typedef struct {
    uint32_t state[8];
    uint64_t bytes;
    unsigned char block[64];
} bf__sha;

static uint32_t bf__turn(uint32_t value, int by) { return (value >> by) | (value << (32 - by)); }

static void bf__sha_block(bf__sha *sha, const unsigned char *block)
{
    static const uint32_t k[64] = {
        0x428a2f98, 0x71374491, 0xb5c0fbcf, 0xe9b5dba5, 0x3956c25b, 0x59f111f1, 0x923f82a4,
        0xab1c5ed5, 0xd807aa98, 0x12835b01, 0x243185be, 0x550c7dc3, 0x72be5d74, 0x80deb1fe,
        0x9bdc06a7, 0xc19bf174, 0xe49b69c1, 0xefbe4786, 0x0fc19dc6, 0x240ca1cc, 0x2de92c6f,
        0x4a7484aa, 0x5cb0a9dc, 0x76f988da, 0x983e5152, 0xa831c66d, 0xb00327c8, 0xbf597fc7,
        0xc6e00bf3, 0xd5a79147, 0x06ca6351, 0x14292967, 0x27b70a85, 0x2e1b2138, 0x4d2c6dfc,
        0x53380d13, 0x650a7354, 0x766a0abb, 0x81c2c92e, 0x92722c85, 0xa2bfe8a1, 0xa81a664b,
        0xc24b8b70, 0xc76c51a3, 0xd192e819, 0xd6990624, 0xf40e3585, 0x106aa070, 0x19a4c116,
        0x1e376c08, 0x2748774c, 0x34b0bcb5, 0x391c0cb3, 0x4ed8aa4a, 0x5b9cca4f, 0x682e6ff3,
        0x748f82ee, 0x78a5636f, 0x84c87814, 0x8cc70208, 0x90befffa, 0xa4506ceb, 0xbef9a3f7,
        0xc67178f2};
    uint32_t w[64], s[8];
    int t;
    for (t = 0; t < 16; t++)
        w[t] = (uint32_t)block[4 * t] << 24 | (uint32_t)block[4 * t + 1] << 16 |
               (uint32_t)block[4 * t + 2] << 8 | block[4 * t + 3];
    for (t = 16; t < 64; t++)
        w[t] = (bf__turn(w[t - 2], 17) ^ bf__turn(w[t - 2], 19) ^ (w[t - 2] >> 10)) + w[t - 7] +
               (bf__turn(w[t - 15], 7) ^ bf__turn(w[t - 15], 18) ^ (w[t - 15] >> 3)) + w[t - 16];
    memcpy(s, sha->state, sizeof s);
    for (t = 0; t < 64; t++) {
        uint32_t one = s[7] + (bf__turn(s[4], 6) ^ bf__turn(s[4], 11) ^ bf__turn(s[4], 25)) +
                       ((s[4] & s[5]) ^ (~s[4] & s[6])) + k[t] + w[t];
        uint32_t two = (bf__turn(s[0], 2) ^ bf__turn(s[0], 13) ^ bf__turn(s[0], 22)) +
                       ((s[0] & s[1]) ^ (s[0] & s[2]) ^ (s[1] & s[2]));
        memmove(s + 1, s, 7 * sizeof *s);
        s[4] += one;
        s[0] = one + two;
    }
    for (t = 0; t < 8; t++) sha->state[t] += s[t];
}

static void bf__sha_start(bf__sha *sha)
{
    static const uint32_t start[8] = {0x6a09e667, 0xbb67ae85, 0x3c6ef372, 0xa54ff53a,
                                      0x510e527f, 0x9b05688c, 0x1f83d9ab, 0x5be0cd19};
    memcpy(sha->state, start, sizeof start);
    sha->bytes = 0;
}

static void bf__sha_add(bf__sha *sha, const void *data, size_t size)
{
    const unsigned char *bytes = (const unsigned char *)data;
    while (size) {
        size_t used = (size_t)(sha->bytes % 64), part = 64 - used < size ? 64 - used : size;
        memcpy(sha->block + used, bytes, part);
        sha->bytes += part;
        bytes += part;
        size -= part;
        if (sha->bytes % 64 == 0) bf__sha_block(sha, sha->block);
    }
}

static void bf__sha_end(bf__sha *sha, char text[65])
{
    static const unsigned char pad[64] = {0x80};
    uint64_t bits = 8 * sha->bytes;
    unsigned char length[8];
    int n;
    for (n = 0; n < 8; n++) length[n] = (unsigned char)(bits >> (56 - 8 * n));
    bf__sha_add(sha, pad, (size_t)(sha->bytes % 64 < 56 ? 56 - sha->bytes % 64 : 120 - sha->bytes % 64));
    bf__sha_add(sha, length, 8);
    for (n = 0; n < 32; n++) {
        unsigned byte = (sha->state[n / 4] >> (24 - 8 * (n % 4))) & 255;
        text[2 * n] = "0123456789abcdef"[byte >> 4];
        text[2 * n + 1] = "0123456789abcdef"[byte & 15];
    }
    text[64] = 0;
}

/* ---- files ---- */

/* A folder that stays the same one whatever its path leads to meanwhile. */
typedef struct {
    const char *path;
    int number;
} bf__folder;

static bf_status bf__enter(bf__folder *folder, const char *path)
{
    folder->path = path;
    folder->number = -1;
#ifndef _WIN32
    folder->number = open(path, O_RDONLY | O_DIRECTORY);
    /* That it is not there says that it is no field, that it may not be read does not. */
    if (folder->number < 0) return errno == ENOENT || errno == ENOTDIR ? BF_NOT_A_FIELD : BF_CANNOT_READ;
#endif
    return BF_OK;
}

static void bf__leave(bf__folder *folder)
{
#ifndef _WIN32
    close(folder->number);
#else
    (void)folder;
#endif
}

/* A file of the folder, opened for reading; NULL, and errno says why, where that fails. */
static FILE *bf__file(const bf__folder *folder, const char *name, size_t length)
{
    size_t before = strlen(folder->path) + 1;
    char *path = (char *)malloc(before + length + 1);
    FILE *file = NULL;
    if (!path) return NULL;
    memcpy(path, folder->path, before - 1);
    path[before - 1] = '/';
    memcpy(path + before, name, length);
    path[before + length] = 0;
#ifdef _WIN32
    file = fopen(path, "rb");
    /* Such names as COM1 are devices in every folder, and one never ends. */
    if (file) {
        struct _stat64 about;
        if (_fstat64(_fileno(file), &about) != 0 || !(about.st_mode & _S_IFREG)) {
            fclose(file);
            file = NULL;
            errno = EINVAL;
        }
    }
#else
    {
        /* A pipe would let us wait for who writes into it, and a device never ends. */
        int number = openat(folder->number, path + before, O_RDONLY | O_NONBLOCK);
        struct stat about;
        if (number >= 0) {
            if (!fstat(number, &about) && S_ISREG(about.st_mode)) file = fdopen(number, "rb");
            else errno = EINVAL;
            if (!file) close(number);
        }
    }
#endif
    free(path);
    return file;
}

/* A whole small file, newly allocated. */
static bf_status bf__read(const bf__folder *folder, const char *name, char **text, size_t *length)
{
    FILE *file = bf__file(folder, name, strlen(name));
    size_t room = 0, part = 1;
    *text = NULL;
    *length = 0;
    if (!file) return BF_CANNOT_READ;
    while (part) {
        if (*length == room) {
            char *more = (char *)realloc(*text, room = 2 * room + 65536);
            if (!more) break;
            *text = more;
        }
        part = fread(*text + *length, 1, room - *length, file);
        *length += part;
    }
    if (ferror(file) || part) {
        free(*text);
        *text = NULL;
        fclose(file);
        return part ? BF_NO_MEMORY : BF_CANNOT_READ;
    }
    fclose(file);
    return BF_OK;
}

/* Size and SHA-256 of a file. */
static bf_status bf__digest(const bf__folder *folder, const char *name, size_t length, double *size,
                            char sha256[65])
{
    unsigned char buffer[8192];
    FILE *file = bf__file(folder, name, length);
    bf__sha sha;
    size_t part;
    if (!file) return BF_CANNOT_READ;
    bf__sha_start(&sha);
    while ((part = fread(buffer, 1, sizeof buffer, file)) > 0) bf__sha_add(&sha, buffer, part);
    *size = (double)sha.bytes;
    bf__sha_end(&sha, sha256);
    part = (size_t)ferror(file);
    fclose(file);
    return part ? BF_CANNOT_READ : BF_OK;
}

/* A name that stays inside the folder. */
static int bf__inside(const char *name, size_t length)
{
    size_t n;
    if (length == 0 || name[0] == '/') return 0;
    for (n = 0; n < length; n++) {
        if (name[n] == '\\' || (unsigned char)name[n] < 32) return 0;
        if (name[n] == '.' && n + 1 < length && name[n + 1] == '.') return 0;
    }
    return 1;
}

/* The text of a store's manifest, newly allocated. */
static bf_status bf__manifest(const bf__folder *folder, char **text, size_t *length)
{
    bf_status status = bf__read(folder, "manifest.json", text, length);
    return status == BF_CANNOT_READ && errno == ENOENT ? BF_NOT_A_FIELD : status;
}

/* Compare files with a manifest: all of them, or of one name alone the text that was read. */
static bf_status bf__check(const bf__folder *folder, const char *text, size_t length, const char *only,
                           const char *content, size_t content_length)
{
    char sha256[65];
    const char *key, *digest;
    size_t span, digest_span;
    int first = 1, inner, checked = 0;
    bf__json j;
    bf_status status = BF_OK;
    j.at = text;
    j.end = text + length;
    j.bad = 0;
    if (!bf__find(&j, "files")) j.bad = 1;
    while (status == BF_OK && bf__key(&j, &first, &key, &span)) {
        const char *name = key;
        size_t name_span = span;
        double size = -1, found = -2;
        digest = NULL;
        digest_span = 0;
        for (inner = 1; bf__key(&j, &inner, &key, &span);) {
            if (bf__is(key, span, "size")) size = bf__number(&j);
            else if (bf__is(key, span, "sha256")) bf__string(&j, &digest, &digest_span);
            else bf__skip(&j, 0);
        }
        if (j.bad || !bf__inside(name, name_span)) {
            j.bad = 1;
            break;
        }
        if (only && !bf__is(name, name_span, only)) continue;
        if (only) {
            bf__sha sha;
            bf__sha_start(&sha);
            bf__sha_add(&sha, content, content_length);
            found = (double)content_length;
            bf__sha_end(&sha, sha256);
        } else {
            status = bf__digest(folder, name, name_span, &found, sha256);
        }
        if (status == BF_OK && found != size) status = BF_WRONG_SIZE;
        if (status == BF_OK && !bf__is(digest, digest_span, sha256)) status = BF_DAMAGED;
        checked++;
    }
    if (status != BF_OK) return status;
    return j.bad || !checked ? BF_NOT_A_FIELD : BF_OK;
}

/* Compare a manifest with its own digest, which is that of its text without the line that tells it. */
static bf_status bf__sealed(const char *text, size_t length)
{
    char sha256[65];
    const char *digest, *line, *end = text + length;
    size_t span;
    bf__json j;
    bf__sha sha;
    j.at = text;
    j.end = end;
    j.bad = 0;
    if (!bf__find(&j, "sha256")) return BF_DAMAGED;
    bf__string(&j, &digest, &span);
    if (j.bad) return BF_DAMAGED;
    for (line = digest; line > text && line[-1] != '\n';) line--;
    bf__sha_start(&sha);
    bf__sha_add(&sha, text, (size_t)(line - text));
    for (line = digest + span; line < end && *line != '\n';) line++;
    if (line < end) bf__sha_add(&sha, line + 1, (size_t)(end - line - 1));
    bf__sha_end(&sha, sha256);
    return bf__is(digest, span, sha256) ? BF_OK : BF_DAMAGED;
}

bf_status bf_verify(const char *path)
{
    bf_field field;
    bf__folder folder;
    char *text;
    size_t length;
    bf_status status = bf__enter(&folder, path);
    if (status != BF_OK) return status;
    status = bf__manifest(&folder, &text, &length);
    if (status == BF_OK) {
        status = bf__check(&folder, text, length, NULL, NULL, 0);
        if (status == BF_OK) status = bf__sealed(text, length);
        free(text);
    }
    bf__leave(&folder);
    if (status == BF_OK) status = bf_open(&field, path);
    if (status == BF_OK) bf_close(&field);
    return status;
}

/* One file of exactly that many bytes in memory, read-only. */
static bf_status bf__map(const bf__folder *folder, const char *name, size_t bytes, const float **values)
{
#ifdef _WIN32
    FILE *file = bf__file(folder, name, strlen(name));
    float *copy = (float *)malloc(bytes);
    size_t read = 0;
    if (file && copy) read = fread(copy, 1, bytes, file);
    if (!file || !copy || read != bytes || fgetc(file) != EOF) {
        bf_status status = !file ? BF_CANNOT_READ : !copy ? BF_NO_MEMORY : BF_WRONG_SIZE;
        if (file) fclose(file);
        free(copy);
        return status;
    }
    fclose(file);
    *values = copy;
    return BF_OK;
#else
    struct stat about;
    void *mapped;
    /* A pipe has no bytes, but would let us wait for who writes into it. */
    int file = openat(folder->number, name, O_RDONLY | O_NONBLOCK);
    if (file < 0) return BF_CANNOT_READ;
    if (fstat(file, &about) != 0 || (uint64_t)about.st_size != (uint64_t)bytes) {
        close(file);
        return BF_WRONG_SIZE;
    }
    mapped = mmap(NULL, bytes, PROT_READ, MAP_SHARED, file, 0);
    close(file);
    if (mapped == MAP_FAILED) return BF_NO_MEMORY;
    *values = (const float *)mapped;
    return BF_OK;
#endif
}

static void bf__unmap(const float *values, size_t bytes)
{
    void *start = (void *)(uintptr_t)values;
    if (!values) return;
#ifdef _WIN32
    (void)bytes;
    free(start);
#else
    munmap(start, bytes);
#endif
}

/* Describe and map the store that a manifest is of. */
static bf_status bf__open_as(bf_field *field, const bf__folder *folder, const char *manifest, size_t size)
{
    char *text, name[BF_NAME + 64];
    size_t length;
    int n, k;
    bf_status status = bf__read(folder, "zarr.json", &text, &length);
    if (status != BF_OK) return status;
    status = bf__check(folder, manifest, size, "zarr.json", text, length);
    if (status == BF_OK) status = bf_describe(field, text, length);
    free(text);
    for (n = 0; status == BF_OK && n < field->structures; n++) {
        bf_structure_part *part = &field->structure[n];
        part->coefficients = (const float **)calloc((size_t)field->phases, sizeof(float *));
        if (!part->coefficients) status = BF_NO_MEMORY;
        for (k = 0; status == BF_OK && k < field->phases; k++) {
            snprintf(name, sizeof name, "spline/%s/c/%d/0/0/0", part->name, k);
            status = bf__map(folder, name, field->bytes, &part->coefficients[k]);
        }
    }
#ifdef _WIN32
    field->copied = status == BF_OK;
#endif
    return status;
}

bf_status bf_open(bf_field *field, const char *path)
{
    char *before = NULL, *after = NULL;
    size_t length, again;
    bf__folder folder;
    bf_status status, now;
    memset(field, 0, sizeof *field);
    status = bf__enter(&folder, path);
    if (status != BF_OK) return status;
    status = bf__manifest(&folder, &before, &length);
    if (status == BF_OK) {
        status = bf__open_as(field, &folder, before, length);
        /* Files may be written over, or taken away, while they are opened. */
        now = bf__manifest(&folder, &after, &again);
        if (now == BF_OK ? again != length || memcmp(before, after, length) != 0 : now == BF_NOT_A_FIELD)
            status = BF_REPLACED;
        else if (status == BF_OK) status = now;
        if (status != BF_OK) bf_close(field);
    }
    free(before);
    free(after);
    bf__leave(&folder);
    return status;
}

#ifndef _WIN32
/* Copies in the place of mapped files; all, or none. Not of malloc: to unlock pages of its heap would
 * take from the program what mlockall has locked. */
static bf_status bf__copy(bf_field *field)
{
    size_t count = (size_t)field->structures * (size_t)field->phases, at;
    void **copies = (void **)calloc(count, sizeof(void *));
    if (!copies) return BF_NO_MEMORY;
    for (at = 0; at < count; at++) {
        const bf_structure_part *part = &field->structure[at / (size_t)field->phases];
        const int own = MAP_PRIVATE | BF__ANONYMOUS;
        copies[at] = mmap(NULL, field->bytes, PROT_READ | PROT_WRITE, own, -1, 0);
        if (copies[at] == MAP_FAILED) break;
        memcpy(copies[at], part->coefficients[at % (size_t)field->phases], field->bytes);
    }
    if (at < count) {
        while (at--) munmap(copies[at], field->bytes);
        free(copies);
        return BF_NO_MEMORY;
    }
    for (at = 0; at < count; at++) {
        const bf_structure_part *part = &field->structure[at / (size_t)field->phases];
        const float **values = &part->coefficients[at % (size_t)field->phases];
        bf__unmap(*values, field->bytes);
        *values = (const float *)copies[at];
    }
    free(copies);
    field->copied = 1;
    return BF_OK;
}
#endif

static int bf__all_finite(const bf_field *field)
{
    size_t at, count = field->bytes / sizeof(float);
    int n, k;
    for (n = 0; n < field->structures; n++)
        for (k = 0; k < field->phases; k++) {
            const float *values = field->structure[n].coefficients[k];
            /* Neither of what is no number nor of what is infinite is the difference zero. */
            for (at = 0; at < count; at++)
                if (!(values[at] - values[at] == 0)) return 0;
        }
    return 1;
}

bf_status bf_lock(bf_field *field)
{
    bf_status status = BF_OK;
#ifndef _WIN32
    int n, k;
#endif
    if (!field->structure) return BF_NOT_A_FIELD;
#ifndef _WIN32
    if (!field->copied) status = bf__copy(field);
#endif
    if (!bf__all_finite(field)) return BF_DAMAGED;
#ifndef _WIN32
    for (n = 0; status != BF_NO_MEMORY && n < field->structures; n++)
        for (k = 0; k < field->phases; k++)
            if (mlock(field->structure[n].coefficients[k], field->bytes) != 0) status = BF_CANNOT_LOCK;
#else
    /* They were copied as they were opened, into memory that Windows may page out. */
    status = BF_CANNOT_LOCK;
#endif
    return status;
}

void bf_close(bf_field *field)
{
    int n, k;
    for (n = 0; field->structure && n < field->structures; n++) {
        for (k = 0; field->structure[n].coefficients && k < field->phases; k++)
            bf__unmap(field->structure[n].coefficients[k], field->bytes);
        free((void *)field->structure[n].coefficients);
    }
    free(field->structure);
    free(field->fixture);
    free(field->phase);
    free(field->line);
    memset(field, 0, sizeof *field);
}

int bf_structure(const bf_field *field, const char *name)
{
    int n;
    for (n = 0; n < field->structures; n++)
        if (strcmp(field->structure[n].name, name) == 0) return n;
    return -1;
}

int bf_fixture(const bf_field *field, const char *name)
{
    int n;
    for (n = 0; n < field->fixtures; n++)
        if (strcmp(field->fixture[n].name, name) == 0) return n;
    return -1;
}

/* ---- queries: no allocation, no system call, nothing written but the answer ---- */

/* Three neighbours on one axis, their weights, and their slopes per step of the grid. */
BF__INLINE void bf__three(double place, int count, ptrdiff_t index[3], double weight[3], double slope[3])
{
    int middle;
    double t;
    if (!(place > 0)) place = 0;
    if (place > count - 1) place = count - 1;
    middle = (int)(place + 0.5);
    t = place - middle;
    weight[0] = 0.5 * (0.5 - t) * (0.5 - t);
    weight[1] = 0.75 - t * t;
    weight[2] = 0.5 * (0.5 + t) * (0.5 + t);
    slope[0] = t - 0.5;
    slope[1] = -2 * t;
    slope[2] = t + 0.5;
    index[0] = middle - 1;
    index[1] = middle;
    index[2] = middle + 1;
    /* Beyond an end the coefficients go on in a straight line: fold the ghost into the others. */
    if (middle == 0) {
        weight[1] += 2 * weight[0];
        weight[2] -= weight[0];
        slope[1] += 2 * slope[0];
        slope[2] -= slope[0];
        weight[0] = slope[0] = 0;
        index[0] = 0;
    }
    if (middle == count - 1) {
        weight[1] += 2 * weight[2];
        weight[0] -= weight[2];
        slope[1] += 2 * slope[2];
        slope[0] -= slope[2];
        weight[2] = slope[2] = 0;
        index[2] = middle;
    }
}

/* The interval that a phase lies in, and the phase brought to it. */
BF__INLINE int bf__interval(const bf_field *field, double phase, double *turned)
{
    const double *line = field->line;
    double first = line[0], found = phase;
    int low, high = field->phases;
    if (!(found >= first && found < first + 1)) {
        found -= floor(phase - first);
        if (found >= first + 1) found -= 1;
        else if (found < first) found += 1; /* so large a phase that first is lost in it */
    }
    *turned = found;
    /* Phases are mostly evenly spaced; where they are not, halving finds the interval. */
    low = (int)((found - first) * high);
    if (low < 0 || low >= high || line[4 * low] > found || line[4 * low + 1] <= found) {
        for (low = 0; high - low > 1;) {
            int middle = (low + high) / 2;
            if (line[4 * middle] <= found) low = middle;
            else high = middle;
        }
    }
    return low;
}

/* The same, and the weights of the interval's three phases. */
BF__INLINE int bf__moment(const bf_field *field, double phase, double weight[3])
{
    double turned, early, late;
    int k = bf__interval(field, phase, &turned);
    const double *line = field->line + 4 * k;
    early = line[1] - turned;
    late = turned - line[0];
    weight[0] = early * early * line[2];
    weight[2] = late * late * line[3];
    weight[1] = 1 - weight[0] - weight[2];
    return k;
}

/* Where a question falls: the nodes, the weights, and the coefficients of three phases. */
typedef struct {
    double time[3], wx[3], wy[3], wz[3], sx[3], sy[3], sz[3];
    ptrdiff_t ix[3], iy[3], iz[3];
    const float *phase[3];
} bf__place;

BF__INLINE void bf__locate(const bf_field *field, int structure, const double point_mm[3], double phase,
                           bf__place *at)
{
    const float *const *all = (const float *const *)field->structure[structure].coefficients;
    int k = bf__moment(field, phase, at->time);
    at->phase[0] = all[k > 0 ? k - 1 : field->phases - 1];
    at->phase[1] = all[k];
    at->phase[2] = all[k + 1 < field->phases ? k + 1 : 0];
    bf__three((point_mm[0] - field->origin_mm[0]) * field->per_mm[0], field->shape[0], at->ix, at->wx, at->sx);
    bf__three((point_mm[1] - field->origin_mm[1]) * field->per_mm[1], field->shape[1], at->iy, at->wy, at->sy);
    bf__three((point_mm[2] - field->origin_mm[2]) * field->per_mm[2], field->shape[2], at->iz, at->wz, at->sz);
}

#ifdef BF__WIDE
/* Weights of three neighbours along x as those of four nodes from base on. */
BF__WIDE static __m256d bf__four(const double weight[3], ptrdiff_t left)
{
    double spread[6] = {0, 0, 0, 0, 0, 0};
    if (left == 0) return _mm256_setr_pd(weight[0], weight[1], weight[2], 0);
    /* At the ends: one neighbour is a ghost without weight. */
    memcpy(spread + 1 + left, weight, 3 * sizeof(double));
    return _mm256_loadu_pd(spread + 1);
}

/* Sums of rows of four nodes, by the weights along y and z, and by the slopes along one of them. */
typedef struct {
    __m256d value, along_y, along_z;
} bf__rows;

/* Add the row that starts at a node. */
BF__WIDE BF__INLINE void bf__wide_row(const bf__place *at, const __m256d time[3], ptrdiff_t start,
                                      int b, bf__rows *plane)
{
    __m256d nodes = _mm256_mul_pd(time[0], _mm256_cvtps_pd(_mm_loadu_ps(at->phase[0] + start)));
    nodes = _mm256_fmadd_pd(time[1], _mm256_cvtps_pd(_mm_loadu_ps(at->phase[1] + start)), nodes);
    nodes = _mm256_fmadd_pd(time[2], _mm256_cvtps_pd(_mm_loadu_ps(at->phase[2] + start)), nodes);
    plane->value = _mm256_fmadd_pd(_mm256_set1_pd(at->wy[b]), nodes, plane->value);
    plane->along_y = _mm256_fmadd_pd(_mm256_set1_pd(at->sy[b]), nodes, plane->along_y);
}

/* Add the three rows of one plane; written out, as a loop over them takes an eighth longer. */
BF__WIDE BF__INLINE void bf__wide_plane(const bf__place *at, const __m256d time[3], ptrdiff_t layer,
                                        const ptrdiff_t row[3], int c, bf__rows *sums)
{
    ptrdiff_t from = at->iz[c] * layer;
    __m256d weight = _mm256_set1_pd(at->wz[c]);
    bf__rows plane;
    plane.value = plane.along_y = _mm256_setzero_pd();
    bf__wide_row(at, time, from + row[0], 0, &plane);
    bf__wide_row(at, time, from + row[1], 1, &plane);
    bf__wide_row(at, time, from + row[2], 2, &plane);
    sums->value = _mm256_fmadd_pd(weight, plane.value, sums->value);
    sums->along_y = _mm256_fmadd_pd(weight, plane.along_y, sums->along_y);
    sums->along_z = _mm256_fmadd_pd(_mm256_set1_pd(at->sz[c]), plane.value, sums->along_z);
}

/* bf__sum by rows of four nodes, summed along x last. */
BF__WIDE static double bf__wide_sum(const bf_field *field, const bf__place *at, double gradient[3])
{
    ptrdiff_t width = field->shape[0], layer = width * field->shape[1], base, left, row[3];
    bf__rows sums;
    __m256d time[3], wx, sx, low, high;
    double found[4];
    base = at->ix[1] - 1 < 0 ? 0 : at->ix[1] - 1 > width - 4 ? width - 4 : at->ix[1] - 1;
    left = at->ix[1] - 1 - base;
    row[0] = at->iy[0] * width + base;
    row[1] = at->iy[1] * width + base;
    row[2] = at->iy[2] * width + base;
    time[0] = _mm256_set1_pd(at->time[0]);
    time[1] = _mm256_set1_pd(at->time[1]);
    time[2] = _mm256_set1_pd(at->time[2]);
    sums.value = sums.along_y = sums.along_z = _mm256_setzero_pd();
    bf__wide_plane(at, time, layer, row, 0, &sums);
    bf__wide_plane(at, time, layer, row, 1, &sums);
    bf__wide_plane(at, time, layer, row, 2, &sums);
    wx = bf__four(at->wx, left);
    sx = bf__four(at->sx, left);
    low = _mm256_hadd_pd(_mm256_mul_pd(sums.value, wx), _mm256_mul_pd(sums.value, sx));
    high = _mm256_hadd_pd(_mm256_mul_pd(sums.along_y, wx), _mm256_mul_pd(sums.along_z, wx));
    _mm256_storeu_pd(found, _mm256_add_pd(_mm256_permute2f128_pd(low, high, 0x20),
                                          _mm256_permute2f128_pd(low, high, 0x31)));
    gradient[0] = found[1] * field->per_mm[0];
    gradient[1] = found[2] * field->per_mm[1];
    gradient[2] = found[3] * field->per_mm[2];
    return found[0];
}
#endif

/* Distance and gradient at a place. */
static double bf__sum(const bf_field *field, const bf__place *at, double gradient[3])
{
    ptrdiff_t width = field->shape[0], layer = width * field->shape[1];
    double value = 0;
    int b, c;
    gradient[0] = gradient[1] = gradient[2] = 0;
    for (c = 0; c < 3; c++) {
        double plane = 0, plane_x = 0, plane_y = 0;
        for (b = 0; b < 3; b++) {
            double node[3], line;
            int a;
            for (a = 0; a < 3; a++) {
                ptrdiff_t n = at->iz[c] * layer + at->iy[b] * width + at->ix[a];
                node[a] = at->time[0] * (double)at->phase[0][n] + at->time[1] * (double)at->phase[1][n] +
                          at->time[2] * (double)at->phase[2][n];
            }
            line = at->wx[0] * node[0] + at->wx[1] * node[1] + at->wx[2] * node[2];
            plane += at->wy[b] * line;
            plane_x += at->wy[b] * (at->sx[0] * node[0] + at->sx[1] * node[1] + at->sx[2] * node[2]);
            plane_y += at->sy[b] * line;
        }
        value += at->wz[c] * plane;
        gradient[0] += at->wz[c] * plane_x;
        gradient[1] += at->wz[c] * plane_y;
        gradient[2] += at->sz[c] * plane;
    }
    gradient[0] *= field->per_mm[0];
    gradient[1] *= field->per_mm[1];
    gradient[2] *= field->per_mm[2];
    return value;
}

static double bf__sum_at(const bf_field *field, const bf__place *at, double gradient[3])
{
#ifdef BF__WIDE
    if (field->wide) return bf__wide_sum(field, at, gradient);
#endif
    return bf__sum(field, at, gradient);
}

/* Distance, and gradient, at a point whose numbers are finite. */
static double bf__at(const bf_field *field, int structure, const double point_mm[3], double phase,
                     double gradient[3])
{
    bf__place at;
    bf__locate(field, structure, point_mm, phase, &at);
    return bf__sum_at(field, &at, gradient);
}

static double bf__height(const bf_fixture_part *law, double distance_mm)
{
    double q = law->side == 0 ? fabs(distance_mm) : law->side * distance_mm, s, power = 1;
    int m = law->m;
    if (q <= 0) return 0;
    s = q * q / (2 * law->delta_mm * law->delta_mm);
    for (; m; m >>= 1, s *= s)
        if (m & 1) power *= s;
    /* exp(-40) is less than what a double can be short of 1. */
    return power > 40 ? 1 : -expm1(-power);
}

/* The force where the distance and its gradient are known. */
static void bf__push(const bf_fixture_part *law, double distance_mm, const double gradient[3], double force_n[3])
{
    double length = sqrt(gradient[0] * gradient[0] + gradient[1] * gradient[1] + gradient[2] * gradient[2]);
    double scale = -law->f_max_n * bf__height(law, distance_mm) / (length > 0.5 ? length : 0.5);
    if (law->side == 0 ? distance_mm < 0 : law->side < 0) scale = -scale;
    force_n[0] = scale * gradient[0];
    force_n[1] = scale * gradient[1];
    force_n[2] = scale * gradient[2];
}

static int bf__finite(const double point_mm[3], double phase)
{
    /* Not a number and infinity both fail this, and so does the sum of huge numbers. */
    return bf__numeric(point_mm[0] + point_mm[1] + point_mm[2] + phase);
}

/* Whether an answer holds only numbers: a value of the field that is none leaves none in the
 * distance of any answer that it has a part in, whatever its weight. */
BF__INLINE int bf__sound(double distance_mm) { return bf__numeric(distance_mm); }

/* Whether a fixture can be asked about a point. */
BF__INLINE bf_status bf__answerable(const bf_field *field, int fixture, const double point_mm[3],
                                    double phase)
{
    if (fixture < 0 || fixture >= field->fixtures) return BF_NO_SUCH_NAME;
    return bf__finite(point_mm, phase) ? BF_OK : BF_NOT_FINITE;
}

bf_status bf_distance(const bf_field *field, int structure, const double point_mm[3], double phase,
                      double *distance_mm, double gradient[3])
{
    double slope[3] = {0, 0, 0}, distance = 0;
    bf_status status = structure < 0 || structure >= field->structures ? BF_NO_SUCH_NAME
                       : bf__finite(point_mm, phase)                   ? BF_OK
                                                                       : BF_NOT_FINITE;
    if (status == BF_OK) {
        distance = bf__at(field, structure, point_mm, phase, slope);
        if (!bf__sound(distance)) {
            distance = slope[0] = slope[1] = slope[2] = 0;
            status = BF_DAMAGED;
        }
    }
    if (distance_mm) *distance_mm = distance;
    if (gradient) memcpy(gradient, slope, sizeof slope);
    return status;
}

bf_status bf_potential(const bf_field *field, int fixture, const double point_mm[3], double phase,
                       double *potential)
{
    double slope[3], distance;
    const bf_fixture_part *law;
    bf_status status = bf__answerable(field, fixture, point_mm, phase);
    *potential = 0;
    if (status != BF_OK) return status;
    law = &field->fixture[fixture];
    distance = bf__at(field, law->structure, point_mm, phase, slope);
    if (!bf__sound(distance)) return BF_DAMAGED;
    *potential = bf__height(law, distance);
    return BF_OK;
}

bf_status bf_force(const bf_field *field, int fixture, const double point_mm[3], double phase,
                   double force_n[3])
{
    double slope[3], distance;
    const bf_fixture_part *law;
    bf_status status = bf__answerable(field, fixture, point_mm, phase);
    if (status == BF_OK) {
        law = &field->fixture[fixture];
        distance = bf__at(field, law->structure, point_mm, phase, slope);
        if (bf__sound(distance)) {
            bf__push(law, distance, slope, force_n);
            return BF_OK;
        }
        status = BF_DAMAGED;
    }
    memset(force_n, 0, 3 * sizeof(double));
    return status;
}

/* ---- batches ---- */

/* Whether all questions of a batch can be asked. */
static bf_status bf__askable(size_t count, const double *points_mm, const double *phases, size_t phase_count)
{
    size_t n;
    if (phase_count != 1 && phase_count != count) return BF_WRONG_SIZE;
    for (n = 0; n < count; n++)
        if (!bf__finite(points_mm + 3 * n, phases[phase_count == 1 ? 0 : n])) return BF_NOT_FINITE;
    return BF_OK;
}

typedef struct {
    const bf_field *field;
    const bf_fixture_part *law; /* NULL where distances are asked for */
    int structure;
    size_t count;
    const double *points_mm, *phases;
    int many_phases;
    double *first, *rest; /* forces; or distances, and gradients, or NULL */
    int slabs;            /* into which the grid is cut along z, where questions are sorted */
} bf__batch;

enum {
    BF__FEW = 1024,        /* fewer questions than this are answered as they come */
    BF__BINS = 4096,       /* into no more than this they are sorted */
    BF__CACHE = 1 << 19,   /* bytes of coefficients that the questions of a bin may ask for */
    BF__LINE = 64,         /* bytes that the processor reads at a time */
    BF__MANY_LINES = 16,   /* the most that are fetched ahead with one question */
    BF__AHEAD = 16         /* how many steps ahead a question is located */
};

/* Answer the question in a note (x, y, z, phase) in its place: distance and gradient, or force.
 * Whether the answer is sound. */
static int bf__answer(const bf__batch *batch, double note[4])
{
    double slope[3], distance = bf__at(batch->field, batch->structure, note, note[3], slope);
    int sound = bf__sound(distance);
    if (batch->law) {
        bf__push(batch->law, distance, slope, note);
    } else {
        note[0] = distance;
        memcpy(note + 1, slope, sizeof slope);
    }
    return sound;
}

static double bf__when(const bf__batch *batch, size_t n) { return batch->phases[batch->many_phases ? n : 0]; }

static void bf__note(const bf__batch *batch, size_t n, double note[4])
{
    memcpy(note, batch->points_mm + 3 * n, 3 * sizeof(double));
    note[3] = bf__when(batch, n);
}

static void bf__write(const bf__batch *batch, size_t n, const double note[4])
{
    if (batch->law) {
        memcpy(batch->first + 3 * n, note, 3 * sizeof(double));
    } else {
        batch->first[n] = note[0];
        if (batch->rest) memcpy(batch->rest + 3 * n, note + 1, 3 * sizeof(double));
    }
}

/* Whether questions follow one another, as far as a few pairs of them tell: then each finds in the
 * cache what the last has read. */
static int bf__follow(const bf__batch *batch)
{
    enum { PAIRS = 64 };
    const bf_field *field = batch->field;
    size_t n;
    int apart = 0, pair, axis; /* windows.h makes nothing of the word far */
    for (pair = 0; pair < PAIRS; pair++) {
        double way = 0, beats;
        const double *point_mm;
        n = (batch->count - 2) / PAIRS * (size_t)pair;
        point_mm = batch->points_mm + 3 * n;
        for (axis = 0; axis < 3; axis++)
            way += fabs(point_mm[3 + axis] - point_mm[axis]) * field->per_mm[axis];
        beats = bf__when(batch, n + 1) - bf__when(batch, n);
        beats = fabs(beats - floor(beats + 0.5));
        apart += way > 4 || beats * field->phases > 2;
    }
    return apart < PAIRS / 4;
}

/* Into which of the bins a question falls: by height first, then by phase. */
static int bf__bin(const bf__batch *batch, size_t n)
{
    const bf_field *field = batch->field;
    double turned, place = (batch->points_mm[3 * n + 2] - field->origin_mm[2]) * field->per_mm[2] / field->shape[2];
    int slab = place > 0 ? place < 1 ? (int)(place * batch->slabs) : batch->slabs - 1 : 0;
    return slab * field->phases + bf__interval(field, bf__when(batch, n), &turned);
}

static void bf__fetch(const void *address)
{
#ifdef __GNUC__
    /* Not into the innermost cache, which is too small for it. */
    __builtin_prefetch(address, 0, 2);
#else
    (void)address;
#endif
}

/* Answer the notes of one bin, and bring meanwhile into the cache the coefficients that the next one
 * will ask for: those of one more phase in the same slab. Whether all answers are sound. */
static int bf__answer_bin(const bf__batch *batch, int bin, double *notes, size_t count)
{
    const bf_field *field = batch->field;
    int next = bin + 1 < batch->slabs * field->phases ? bin + 1 : bin;
    int phase = (next % field->phases + 1) % field->phases, slab = next / field->phases;
    size_t layer = sizeof(float) * (size_t)field->shape[0] * (size_t)field->shape[1], n;
    size_t low = (size_t)slab * (size_t)field->shape[2] / (size_t)batch->slabs;
    size_t high = ((size_t)slab + 1) * (size_t)field->shape[2] / (size_t)batch->slabs + 2;
    const char *start = (const char *)field->structure[batch->structure].coefficients[phase];
    size_t from, each;
    int sound = 1;
    if (high > (size_t)field->shape[2]) high = (size_t)field->shape[2];
    from = (low ? low - 1 : 0) * layer;
    each = count ? (high * layer - from) / BF__LINE / count + 1 : 0;
    for (n = 0; n < count; n++) {
        size_t line;
        /* Where few ask, most of what would be brought is not asked for. */
        if (each <= BF__MANY_LINES)
            for (line = 0; line < each && from < high * layer; line++, from += BF__LINE) bf__fetch(start + from);
        sound &= bf__answer(batch, notes + 4 * n);
    }
    return sound;
}

/* Random questions, those about neighbouring coefficients after one another: a counting sort moves
 * them into the notes and their answers back. Meanwhile the numbers of their bins lie where the
 * answers will. Whether all answers are sound. */
static int bf__answer_sorted(bf__batch *batch, double *notes)
{
    unsigned end[BF__BINS + 1];
    int most = BF__BINS / batch->field->phases, bin, bins, sound = 1;
    size_t wanted = 1 + 3 * batch->field->bytes / BF__CACHE, stride = batch->law ? 3 : 1, n;
    batch->slabs = wanted < (size_t)most ? (int)wanted : most;
    if (batch->slabs > batch->field->shape[2]) batch->slabs = batch->field->shape[2];
    bins = batch->slabs * batch->field->phases;
    memset(end, 0, sizeof end);
    for (n = 0; n < batch->count; n++) {
        bin = bf__bin(batch, n);
        batch->first[stride * n] = bin;
        end[bin + 1]++;
    }
    for (bin = 0; bin < bins; bin++) end[bin + 1] += end[bin];
    /* From here to the loop's end, end[bin] is where the bin's next note goes. */
    for (n = 0; n < batch->count; n++)
        bf__note(batch, n, notes + 4 * (size_t)end[(int)batch->first[stride * n]]++);
    for (bin = 0; bin < bins; bin++) {
        size_t start = bin ? end[bin - 1] : 0;
        sound &= bf__answer_bin(batch, bin, notes + 4 * start, end[bin] - start);
    }
    for (bin = bins; bin > 0; bin--) end[bin] = end[bin - 1];
    end[0] = 0;
    for (n = 0; n < batch->count; n++)
        bf__write(batch, n, notes + 4 * (size_t)end[(int)batch->first[stride * n]]++);
    return sound;
}

/* Bring the coefficients of a place into the cache. Inlined, for GCC leaves out calls of functions that
 * only fetch. */
BF__INLINE void bf__expect(const bf_field *field, const bf__place *at)
{
    ptrdiff_t width = field->shape[0], layer = width * field->shape[1];
    int phase, b, c;
    for (phase = 0; phase < 3; phase++)
        for (c = 0; c < 3; c++) {
            const float *plane = at->phase[phase] + at->iz[c] * layer + at->ix[0];
            for (b = 0; b < 3; b++) bf__fetch(plane + at->iy[b] * width);
        }
}

static int bf__same(const bf__place *a, const bf__place *b)
{
    return a->ix[1] == b->ix[1] && a->iy[1] == b->iy[1] && a->iz[1] == b->iz[1] && a->phase[1] == b->phase[1];
}

static void bf__place_of(const bf__batch *batch, size_t n, bf__place *at)
{
    bf__locate(batch->field, batch->structure, batch->points_mm + 3 * n, bf__when(batch, n), at);
}

/* Questions in their order. Each is located some steps ahead of its answer, and where it asks for other
 * coefficients than the one before, these are fetched meanwhile. Whether all answers are sound. */
static int bf__answer_path(const bf__batch *batch)
{
    bf__place ring[BF__AHEAD];
    size_t n, ahead = 0;
    int sound = 1;
    for (n = 0; n < batch->count; n++) {
        double slope[3], *to = batch->rest ? batch->rest + 3 * n : slope, distance;
        for (; ahead < batch->count && ahead < n + BF__AHEAD; ahead++) {
            bf__place *at = ring + ahead % BF__AHEAD;
            bf__place_of(batch, ahead, at);
            if (ahead == 0 || !bf__same(at, ring + (ahead - 1) % BF__AHEAD)) bf__expect(batch->field, at);
        }
        distance = bf__sum_at(batch->field, ring + n % BF__AHEAD, to);
        sound &= bf__sound(distance);
        if (batch->law) bf__push(batch->law, distance, slope, batch->first + 3 * n);
        else batch->first[n] = distance;
    }
    return sound;
}

static bf_status bf__answer_all(bf__batch *batch, double *scratch)
{
    int sound;
    if (scratch && batch->count > 0xffffffffu) return BF_WRONG_SIZE;
    if (scratch && batch->count >= BF__FEW && !bf__follow(batch))
        sound = bf__answer_sorted(batch, scratch);
    else sound = bf__answer_path(batch);
    return sound ? BF_OK : BF_DAMAGED;
}

/* Numbers that are no answers made zeros. */
static void bf__clear(double *numbers, size_t count)
{
    if (numbers && count) memset(numbers, 0, count * sizeof(double));
}

bf_status bf_distances(const bf_field *field, int structure, size_t count, const double *points_mm,
                       const double *phases, size_t phase_count, double *distances_mm,
                       double *gradients, double *scratch)
{
    bf__batch batch;
    bf_status status = structure < 0 || structure >= field->structures
                           ? BF_NO_SUCH_NAME
                           : bf__askable(count, points_mm, phases, phase_count);
    if (status == BF_OK) {
        batch.field = field;
        batch.law = NULL;
        batch.structure = structure;
        batch.count = count;
        batch.points_mm = points_mm;
        batch.phases = phases;
        batch.many_phases = phase_count > 1;
        batch.first = distances_mm;
        batch.rest = gradients;
        batch.slabs = 1;
        status = bf__answer_all(&batch, scratch);
    }
    if (status != BF_OK) {
        bf__clear(distances_mm, count);
        bf__clear(gradients, 3 * count);
    }
    return status;
}

bf_status bf_forces(const bf_field *field, int fixture, size_t count, const double *points_mm,
                    const double *phases, size_t phase_count, double *forces_n, double *scratch)
{
    bf__batch batch;
    bf_status status = fixture < 0 || fixture >= field->fixtures
                           ? BF_NO_SUCH_NAME
                           : bf__askable(count, points_mm, phases, phase_count);
    if (status == BF_OK) {
        batch.field = field;
        batch.law = &field->fixture[fixture];
        batch.structure = batch.law->structure;
        batch.count = count;
        batch.points_mm = points_mm;
        batch.phases = phases;
        batch.many_phases = phase_count > 1;
        batch.first = forces_n;
        batch.rest = NULL;
        batch.slabs = 1;
        status = bf__answer_all(&batch, scratch);
    }
    if (status != BF_OK) bf__clear(forces_n, 3 * count);
    return status;
}

int bf_contains(const bf_field *field, const double point_mm[3])
{
    int axis, inside = field->structures > 0;
    for (axis = 0; axis < 3; axis++) {
        double low_mm = field->origin_mm[axis];
        double high_mm = low_mm + (field->shape[axis] - 1) * field->spacing_mm[axis];
        inside &= point_mm[axis] >= low_mm && point_mm[axis] <= high_mm;
    }
    return inside;
}

void bf_transform(const double t[16], const double point_mm[3], double moved_mm[3])
{
    double x = point_mm[0], y = point_mm[1], z = point_mm[2];
    moved_mm[0] = t[0] * x + t[1] * y + t[2] * z + t[3];
    moved_mm[1] = t[4] * x + t[5] * y + t[6] * z + t[7];
    moved_mm[2] = t[8] * x + t[9] * y + t[10] * z + t[11];
}

void bf_turn_back(const double transform[16], const double vector[3], double turned[3])
{
    const double *t = transform;
    double x = vector[0], y = vector[1], z = vector[2], sum;
    turned[0] = t[0] * x + t[4] * y + t[8] * z;
    turned[1] = t[1] * x + t[5] * y + t[9] * z;
    turned[2] = t[2] * x + t[6] * y + t[10] * z;
    /* Of a tracker that is not known no force is handed on. */
    sum = turned[0] + turned[1] + turned[2];
    if (!bf__numeric(sum)) turned[0] = turned[1] = turned[2] = 0;
}

/* ---- whole tools ---- */

typedef struct {
    double point_mm[3]; /* in the tool's frame */
    double force_n[3];  /* in the MR frame */
    double distance_mm;
} bf__feel;

typedef struct {
    const bf_field *field;
    const bf_fixture_part *law;
    const bf_tool *tool;
    const double *mr_from_tool;
    double phase, bound_n, longest_mm, force_n[3], torque_nmm[3];
    int pieces, piece, evaluations, sound;
    double piece_start_mm, piece_length_mm; /* of the piece that was asked for last */
    bf__feel last;                          /* of the stretch before */
} bf__walk;

enum { BF__DIVISIONS = 8, BF__LONGEST = 20 };

/* Spacings of the grid from end to end of a stretch that is believed, so one from place to place: the
 * spline's curvature changes from node to node, and longer stretches could step over that. */
#define BF__LONGEST_SPACINGS 3.0
/* Share of the bound that a turn of the force between two places may be worth to a stretch. */
#define BF__UNSEEN (1.0 / 3.0)

static double bf__length(const bf_tool *tool, int piece)
{
    const double *a = tool->points_mm + 3 * (size_t)piece;
    const double *b = tool->points_mm + 3 * (size_t)((piece + 1) % tool->count);
    double x = b[0] - a[0], y = b[1] - a[1], z = b[2] - a[2];
    return sqrt(x * x + y * y + z * z);
}

/* Point of the tool at a length along it, in the tool's frame. Places asked for one after the other
 * are near each other, so the piece that holds one is a step or two from the last. */
static void bf__point(bf__walk *walk, double along_mm, double point_mm[3])
{
    const double *a, *b;
    double share;
    int axis;
    while (along_mm > walk->piece_start_mm + walk->piece_length_mm && walk->piece + 1 < walk->pieces) {
        walk->piece_start_mm += walk->piece_length_mm;
        walk->piece_length_mm = bf__length(walk->tool, ++walk->piece);
    }
    while (along_mm < walk->piece_start_mm && walk->piece > 0) {
        walk->piece_length_mm = bf__length(walk->tool, --walk->piece);
        walk->piece_start_mm -= walk->piece_length_mm;
    }
    a = walk->tool->points_mm + 3 * (size_t)walk->piece;
    b = walk->tool->points_mm + 3 * (size_t)((walk->piece + 1) % walk->tool->count);
    share = walk->piece_length_mm > 0 ? (along_mm - walk->piece_start_mm) / walk->piece_length_mm : 0;
    for (axis = 0; axis < 3; axis++) point_mm[axis] = a[axis] + share * (b[axis] - a[axis]);
}

static void bf__ask(bf__walk *walk, double along_mm, bf__feel *feel)
{
    double moved[3], gradient[3];
    const bf_fixture_part *law = walk->law;
    bf__point(walk, along_mm, feel->point_mm);
    bf_transform(walk->mr_from_tool, feel->point_mm, moved);
    feel->distance_mm = bf__at(walk->field, law->structure, moved, walk->phase, gradient);
    walk->sound &= bf__sound(feel->distance_mm);
    bf__push(law, feel->distance_mm, gradient, feel->force_n);
    walk->evaluations++;
}

static void bf__add(bf__walk *walk, const bf__feel *feel, double weight)
{
    double arm[3], lever[3];
    const double *t = walk->mr_from_tool, *f = feel->force_n;
    int axis;
    for (axis = 0; axis < 3; axis++) arm[axis] = feel->point_mm[axis] - walk->tool->handle_mm[axis];
    for (axis = 0; axis < 3; axis++)
        lever[axis] = t[4 * axis] * arm[0] + t[4 * axis + 1] * arm[1] + t[4 * axis + 2] * arm[2];
    for (axis = 0; axis < 3; axis++) walk->force_n[axis] += weight * f[axis];
    walk->torque_nmm[0] += weight * (lever[1] * f[2] - lever[2] * f[1]);
    walk->torque_nmm[1] += weight * (lever[2] * f[0] - lever[0] * f[2]);
    walk->torque_nmm[2] += weight * (lever[0] * f[1] - lever[1] * f[0]);
}

static double bf__apart2(const bf__feel *a, const bf__feel *b)
{
    double x = a->force_n[0] - b->force_n[0], y = a->force_n[1] - b->force_n[1], z = a->force_n[2] - b->force_n[2];
    return x * x + y * y + z * z;
}

static double bf__larger(double a, double b) { return a > b ? a : b; }

/* The stretch of the given length about a middle that has been asked already, as what is next after it.
 * It is asked in the middles of its outer thirds, and divided into thirds until MacLaurin's rule of these
 * places changes the middle's answer by less than the bound, and until a turn of the force between any two
 * of them, or one and that beside the stretch, would be worth less than a third of it: a sixth of the stretch
 * lies on this side of such a turn and would be counted on the other. The distance changes by no more than
 * the way: where even the least distance on the stretch gives a force below the bound, the middle speaks
 * for all of it. */
static void bf__stretch(bf__walk *walk, double middle_mm, double length_mm, double share,
                        const bf__feel *middle, const bf__feel *next, int depth)
{
    bf__feel left, right;
    double way = 0.5 * length_mm, third = length_mm / 3, bound2 = walk->bound_n * walk->bound_n, reach, off = 0;
    double apart2;
    int axis;
    /* Without a number no bound is ever kept, and a tick would be over long before the dividing. */
    if (!walk->sound) return;
    reach = walk->law->side == 0 ? fabs(middle->distance_mm) : walk->law->side * middle->distance_mm;
    if (2 * walk->law->f_max_n * bf__height(walk->law, walk->law->side < 0 ? -(reach + way) : reach + way) <=
        walk->bound_n) {
        bf__add(walk, middle, share);
        walk->last = *middle;
        return;
    }
    bf__ask(walk, middle_mm - third, &left);
    bf__ask(walk, middle_mm + third, &right);
    for (axis = 0; axis < 3; axis++) {
        double change = 0.375 * (left.force_n[axis] + right.force_n[axis]) - 0.75 * middle->force_n[axis];
        off += change * change;
    }
    apart2 = bf__larger(bf__apart2(&left, middle), bf__apart2(middle, &right));
    apart2 = bf__larger(apart2, bf__larger(bf__apart2(&walk->last, &left), bf__apart2(&right, next)));
    if ((length_mm <= walk->longest_mm && off <= bound2 &&
         share * share * apart2 <= 36 * BF__UNSEEN * BF__UNSEEN * bound2) ||
        depth == BF__DIVISIONS) {
        bf__add(walk, &left, share * 0.375);
        bf__add(walk, middle, share * 0.25);
        bf__add(walk, &right, share * 0.375);
        walk->last = right;
        return;
    }
    bf__stretch(walk, middle_mm - third, third, share / 3, &left, middle, depth + 1);
    bf__stretch(walk, middle_mm, third, share / 3, middle, &right, depth + 1);
    bf__stretch(walk, middle_mm + third, third, share / 3, &right, next, depth + 1);
}

bf_status bf_tool_force(const bf_field *field, int fixture, const bf_tool *tool,
                        const double mr_from_tool[16], double phase, double bound_n,
                        double force_n[3], double torque_nmm[3], int *evaluations)
{
    bf__walk walk;
    bf__feel feel, ahead;
    double total = 0, length, sum, diagonal2 = 0;
    int n, stretches;
    memset(force_n, 0, 3 * sizeof(double));
    if (torque_nmm) memset(torque_nmm, 0, 3 * sizeof(double));
    if (evaluations) *evaluations = 0;
    if (fixture < 0 || fixture >= field->fixtures) return BF_NO_SUCH_NAME;
    if (tool->count < 1) return BF_WRONG_SIZE;
    if (!(bound_n > 0) || !bf__numeric(bound_n)) return BF_WRONG_BOUND;
    for (n = 0, sum = phase; n < 12; n++) sum += mr_from_tool[n];
    if (!bf__numeric(sum)) return BF_NOT_FINITE;
    if (!bf__rigid(mr_from_tool)) return BF_NOT_RIGID;
    memset(&walk, 0, sizeof walk);
    walk.field = field;
    walk.law = &field->fixture[fixture];
    walk.tool = tool;
    walk.mr_from_tool = mr_from_tool;
    walk.phase = phase;
    walk.bound_n = bound_n;
    walk.sound = 1;
    walk.pieces = tool->closed ? tool->count : tool->count - 1;
    for (n = 0; n < walk.pieces; n++) total += bf__length(tool, n);
    if (!bf__numeric(total)) return BF_NOT_FINITE;
    for (n = 0; n < 3; n++) {
        double edge = (field->shape[n] - 1) * field->spacing_mm[n];
        diagonal2 += edge * edge;
    }
    if (total > (double)BF__LONGEST * sqrt(diagonal2)) return BF_WRONG_SIZE;
    walk.longest_mm = field->spacing_mm[0];
    for (n = 1; n < 3; n++)
        if (field->spacing_mm[n] < walk.longest_mm) walk.longest_mm = field->spacing_mm[n];
    walk.longest_mm *= BF__LONGEST_SPACINGS;
    if (walk.pieces) walk.piece_length_mm = bf__length(tool, 0);
    length = 3 * walk.longest_mm;
    stretches = total > length ? (int)ceil(total / length < 1e6 ? total / length : 1e6) : 1;
    bf__ask(&walk, 0, &walk.last);
    ahead = walk.last;
    if (total > 0) bf__ask(&walk, 0.5 * total / stretches, &ahead);
    else {
        bf__add(&walk, &walk.last, 1);
        stretches = 0;
    }
    for (n = 0; n < stretches && walk.sound; n++) {
        double middle = (n + 0.5) * total / stretches, after = (n + 1.5) * total / stretches;
        feel = ahead;
        bf__ask(&walk, after < total ? after : total, &ahead);
        bf__stretch(&walk, middle, total / stretches, 1.0 / stretches, &feel, &ahead, 0);
    }
    if (!walk.sound) return BF_DAMAGED;
    /* What no length has told: a handle or an only point that is not finite, or too far away. */
    for (n = 0, sum = 0; n < 3; n++) sum += walk.force_n[n] + walk.torque_nmm[n];
    if (!bf__numeric(sum)) return BF_NOT_FINITE;
    memcpy(force_n, walk.force_n, sizeof walk.force_n);
    if (torque_nmm) memcpy(torque_nmm, walk.torque_nmm, sizeof walk.torque_nmm);
    if (evaluations) *evaluations = walk.evaluations;
    return BF_OK;
}

double bf_outside_share(const bf_field *field, const bf_tool *tool, const double mr_from_tool[16])
{
    double total = 0, outside = 0, share;
    int n, axis, pieces = tool->closed ? tool->count : tool->count - 1;
    if (!bf__rigid(mr_from_tool)) return 1;
    for (n = 0; n < pieces; n++) {
        double a[3], b[3], length = bf__length(tool, n), enters = 0, leaves = 1;
        bf_transform(mr_from_tool, tool->points_mm + 3 * (size_t)n, a);
        bf_transform(mr_from_tool, tool->points_mm + 3 * (size_t)((n + 1) % tool->count), b);
        for (axis = 0; axis < 3; axis++) {
            double low = field->origin_mm[axis] - a[axis], way = b[axis] - a[axis];
            double high = low + (field->shape[axis] - 1) * field->spacing_mm[axis];
            if (way < 0) {
                double swapped = low;
                low = high;
                high = swapped;
            }
            if (way < 0 || way > 0) {
                if (low / way > enters) enters = low / way;
                if (high / way < leaves) leaves = high / way;
            } else if (!(low <= 0 && high >= 0)) leaves = 0;
        }
        total += length;
        outside += leaves > enters ? length * (1 - leaves + enters) : length;
    }
    /* Not so where it is no number: then there is no telling. */
    if (tool->count > 0 && total <= 0) {
        double point_mm[3];
        bf_transform(mr_from_tool, tool->points_mm, point_mm);
        return !bf_contains(field, point_mm);
    }
    share = outside / total;
    return share >= 0 && share <= 1 ? share : 1;
}

/* ---- energy ---- */

bf_tank bf_full_tank(double level_mj, double capacity_mj)
{
    bf_tank tank;
    memset(&tank, 0, sizeof tank);
    tank.capacity_mj = capacity_mj > 0 && bf__numeric(capacity_mj) ? capacity_mj : 0;
    tank.level_mj = level_mj > 0 && bf__numeric(level_mj) ? level_mj : 0;
    if (tank.level_mj > tank.capacity_mj) tank.level_mj = tank.capacity_mj;
    return tank;
}

/* A tank's level below which a force that drives is lessened: over its capacity, and over the work of a
 * tick, of which twenty, each lessened by a twentieth more, take ten and a half. And by how much of the
 * force a tick may withhold more, or less. */
#define BF__LOW 0.1
#define BF__LOW_TICKS 12
#define BF__WITHHOLD 0.05
#define BF__GIVE_BACK 0.005
/* Millimetres or newtons beyond which no tool is and no device pushes: squares of larger ones may be infinite. */
#define BF__NONE 1e100

static int bf__known(const double v[3])
{
    return fabs(v[0]) <= BF__NONE && fabs(v[1]) <= BF__NONE && fabs(v[2]) <= BF__NONE;
}

/* Lessen a force by degrees while it drives and the tank is low; ahead is its work over the last way. What
 * a tool at rest did last stands, or a coarse encoder would tell one thing and the other by turns. Nor
 * does force come back at rest while the tank is low: it could not pay for the next step forward. */
static void bf__lessen(bf_tank *tank, double force_n[3], double *ahead)
{
    double low = BF__LOW * tank->capacity_mj, goal = 0, change;
    int axis;
    if (*ahead > 0 || *ahead < 0) tank->driving = *ahead > 0;
    if (low < BF__LOW_TICKS * *ahead) low = BF__LOW_TICKS * *ahead;
    if (tank->level_mj < low && tank->driving) goal = tank->level_mj > 0 ? 1 - tank->level_mj / low : 1;
    else if (tank->level_mj < low && !(*ahead < 0)) goal = tank->withheld;
    change = goal - tank->withheld;
    if (change > BF__WITHHOLD) change = BF__WITHHOLD;
    if (change < -BF__GIVE_BACK) change = -BF__GIVE_BACK;
    tank->withheld += change;
    for (axis = 0; axis < 3; axis++) force_n[axis] *= 1 - tank->withheld;
    *ahead *= 1 - tank->withheld;
}

void bf_pass(bf_tank *tank, const double point_mm[3], double force_n[3])
{
    double way[3], way2 = 0, work = 0, ahead = 0, allowed, share;
    int axis, seen = bf__known(point_mm);
    if (!seen || !bf__known(force_n)) force_n[0] = force_n[1] = force_n[2] = 0;
    if (!seen) {
        tank->blind = 1;
        return;
    }
    if (!tank->started) {
        memcpy(tank->point_mm, point_mm, sizeof tank->point_mm);
        tank->started = 1;
    }
    for (axis = 0; axis < 3; axis++) {
        way[axis] = point_mm[axis] - tank->point_mm[axis];
        way2 += way[axis] * way[axis];
        work += tank->force_n[axis] * way[axis];
        ahead += force_n[axis] * way[axis];
    }
    /* What the force held since the last tick has really done: newtons times mm are millijoules. Of a
     * way that was not seen only what the hand may have got is counted. */
    if (!tank->blind || work > 0) tank->level_mj -= work;
    tank->blind = 0;
    if (tank->level_mj > tank->capacity_mj) tank->level_mj = tank->capacity_mj;
    allowed = tank->level_mj > 0 ? tank->level_mj : 0;
    bf__lessen(tank, force_n, &ahead);
    /* The next step will be much like the last. In debt, only force against the motion is left. */
    if (way2 > 0 && (ahead > allowed || tank->level_mj < 0)) {
        share = (ahead > allowed ? allowed : ahead) / way2;
        for (axis = 0; axis < 3; axis++) {
            double along = ahead / way2 * way[axis];
            double across = tank->level_mj < 0 ? 0 : force_n[axis] - along;
            force_n[axis] = across + share * way[axis];
        }
    } else if (tank->level_mj < 0 && tank->driving) {
        force_n[0] = force_n[1] = force_n[2] = 0;
    }
    memcpy(tank->point_mm, point_mm, sizeof tank->point_mm);
    memcpy(tank->force_n, force_n, sizeof tank->force_n);
}
#endif /* BEATFIELD_IMPLEMENTATION */
