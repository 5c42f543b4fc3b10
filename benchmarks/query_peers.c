/* Speed of beatfield.h beside a plain trilinear kernel, in one run; bench_query.py compiles this.
 *
 *     query_peers FIELD [structure]
 *
 * prints a line `what<TAB>figure<TAB>number` for each figure; nanoseconds a query unless the name
 * says otherwise.
 */
#define BEATFIELD_IMPLEMENTATION
#include "beatfield.h"
#include <time.h>

enum { STRETCH = 1000, TURNS = 250, COUNT = 4 * TURNS * STRETCH, LATENCIES = 1000000, PIECES = 1000 };

static double *points, *phases, *answers;
static volatile double sink;

static double clock_ns(clockid_t which)
{
    struct timespec t;
    clock_gettime(which, &t);
    return 1e9 * (double)t.tv_sec + (double)t.tv_nsec;
}

/* Latencies are what the clock on the wall says; all else is time of the processor, so that other
 * programs that take turns on it do not count. */
static double now_ns(void) { return clock_ns(CLOCK_MONOTONIC); }
static double used_ns(void) { return clock_ns(CLOCK_THREAD_CPUTIME_ID); }

static uint64_t state = 88172645463325252u;

/* xorshift64*, Vigna, ACM Trans. Math. Softw. 42(4), 2016. */
static double chance(void)
{
    state ^= state >> 12;
    state ^= state << 25;
    state ^= state >> 27;
    return (double)((state * 2685821657736338717u) >> 11) / 9007199254740992.0;
}

/* The peer: linear in space and time, and the gradient of that, which has a step at every face. */
static double trilinear(const bf_field *field, int structure, const double *point, double phase,
                        double *gradient)
{
    const float *const *all = (const float *const *)field->structure[structure].coefficients;
    double t = (phase - floor(phase)) * field->phases, f[3], v[2][2][2];
    ptrdiff_t at[3], step[3];
    int k = (int)t, axis, a, b, c;
    const float *p0 = all[k], *p1 = all[k + 1 < field->phases ? k + 1 : 0];
    t -= k;
    step[0] = 1;
    step[1] = field->shape[0];
    step[2] = step[1] * field->shape[1];
    for (axis = 0; axis < 3; axis++) {
        double place = (point[axis] - field->origin_mm[axis]) / field->spacing_mm[axis];
        if (place < 0) place = 0;
        if (place > field->shape[axis] - 1.000001) place = field->shape[axis] - 1.000001;
        at[axis] = (ptrdiff_t)place;
        f[axis] = place - (double)at[axis];
    }
    p0 += at[0] + at[1] * step[1] + at[2] * step[2];
    p1 += at[0] + at[1] * step[1] + at[2] * step[2];
    for (c = 0; c < 2; c++)
        for (b = 0; b < 2; b++)
            for (a = 0; a < 2; a++) {
                ptrdiff_t n = a + b * step[1] + c * step[2];
                v[c][b][a] = (1 - t) * p0[n] + t * p1[n];
            }
#define BETWEEN(u, v, w) ((u) + (w) * ((v) - (u)))
    {
        double x00 = BETWEEN(v[0][0][0], v[0][0][1], f[0]), x01 = BETWEEN(v[0][1][0], v[0][1][1], f[0]);
        double x10 = BETWEEN(v[1][0][0], v[1][0][1], f[0]), x11 = BETWEEN(v[1][1][0], v[1][1][1], f[0]);
        double y0 = BETWEEN(x00, x01, f[1]), y1 = BETWEEN(x10, x11, f[1]);
        double d00 = v[0][0][1] - v[0][0][0], d01 = v[0][1][1] - v[0][1][0];
        double d10 = v[1][0][1] - v[1][0][0], d11 = v[1][1][1] - v[1][1][0];
        gradient[0] = BETWEEN(BETWEEN(d00, d01, f[1]), BETWEEN(d10, d11, f[1]), f[2]) / field->spacing_mm[0];
        gradient[1] = BETWEEN(x01 - x00, x11 - x10, f[2]) / field->spacing_mm[1];
        gradient[2] = (y1 - y0) / field->spacing_mm[2];
        return BETWEEN(y0, y1, f[2]);
    }
}

static int by_size(const void *a, const void *b)
{
    double x = *(const double *)a, y = *(const double *)b;
    return (x > y) - (x < y);
}

/* A hand's path: 100 mm/s at 1 kHz around the field's middle, a beat of 0.8 s. */
static void on_a_path(const bf_field *field)
{
    double u;
    int n, axis;
    for (n = 0; n < COUNT; n++) {
        for (axis = 0; axis < 3; axis++) {
            double reach = 0.3 * field->spacing_mm[axis] * (field->shape[axis] - 1);
            u = n * 0.1 / reach;
            points[3 * n + axis] = field->origin_mm[axis] + reach / 0.6 +
                                   reach * sin(u * (0.7 + 0.1 * axis) + axis);
        }
        phases[n] = n / 800.0;
    }
}

static void at_random(const bf_field *field, int one_phase)
{
    int n, axis;
    for (n = 0; n < COUNT; n++) {
        for (axis = 0; axis < 3; axis++)
            points[3 * n + axis] = field->origin_mm[axis] +
                                   field->spacing_mm[axis] * (1 + chance() * (field->shape[axis] - 3));
        phases[n] = one_phase ? 0.37 : chance();
    }
}

typedef enum { CALLS, BATCH, FORCES, PEER } way;

/* A stretch of the questions; short, so that most stretches are not interrupted. */
static double stretch(const bf_field *field, int structure, way how, int from)
{
    double start = used_ns(), distance, gradient[3], sum = 0;
    const double *point = points + 3 * (size_t)from;
    int n;
    switch (how) {
    case CALLS:
        for (n = 0; n < STRETCH; n++) {
            bf_distance(field, structure, point + 3 * n, phases[from + n], &distance, gradient);
            sum += distance + gradient[0];
        }
        break;
    case BATCH:
        bf_distances(field, structure, STRETCH, point, phases + from, STRETCH, answers, answers + STRETCH, NULL);
        sum = answers[7];
        break;
    case FORCES:
        bf_forces(field, 0, STRETCH, point, phases + from, STRETCH, answers, NULL);
        sum = answers[7];
        break;
    default:
        for (n = 0; n < STRETCH; n++)
            sum += trilinear(field, structure, point + 3 * n, phases[from + n], gradient) + gradient[0];
    }
    sink = sum;
    return (used_ns() - start) / STRETCH;
}

/* Ours and the peer's by turns, so that what else the machine does weighs on both alike; each
 * stretch is asked once only, so that none finds in the cache what another has read. */
static void compare(const bf_field *field, int structure, const char *where)
{
    static const char *names[4] = {"one by one", "batch", "forces in a batch", "plain trilinear"};
    static double ns[4][TURNS];
    int n, how;
    for (n = 0; n < TURNS; n++)
        for (how = 0; how < 4; how++)
            ns[how][n] = stretch(field, structure, (way)how, (4 * n + how) * STRETCH);
    for (how = 0; how < 4; how++) {
        qsort(ns[how], TURNS, sizeof(double), by_size);
        printf("%s\t%s\t%.2f\n", where, names[how], ns[how][TURNS / 2]);
        printf("%s, quickest tenth\t%s\t%.2f\n", where, names[how], ns[how][TURNS / 10]);
    }
}

/* The questions in batches with scratch room, so that they may be answered in an order that suits
 * the memory. */
static void with_scratch(const bf_field *field, int structure, const char *where)
{
    enum { ROUNDS = 5, SMALL = 1 << 18 };
    static const char *names[3] = {"batch of 1,000,000 with scratch", "batches of 262,144 with scratch",
                                   "forces in a batch with scratch"};
    double *scratch = (double *)malloc(BF_SCRATCH * COUNT * sizeof(double)), ns[3][ROUNDS];
    int n, how, from;
    if (!scratch) return;
    for (n = 0; n < ROUNDS; n++)
        for (how = 0; how < 3; how++) {
            int size = how == 1 ? SMALL : COUNT;
            double start = used_ns();
            for (from = 0; from + size <= COUNT; from += size) {
                const double *point = points + 3 * (size_t)from;
                if (how < 2)
                    bf_distances(field, structure, size, point, phases + from, size, answers, answers + COUNT, scratch);
                else bf_forces(field, 0, size, point, phases + from, size, answers, scratch);
            }
            ns[how][n] = (used_ns() - start) / from;
            sink = answers[7];
        }
    for (how = 0; how < 3; how++) {
        qsort(ns[how], ROUNDS, sizeof(double), by_size);
        printf("%s\t%s\t%.2f\n", where, names[how], ns[how][ROUNDS / 2]);
        printf("%s, quickest tenth\t%s\t%.2f\n", where, names[how], ns[how][0]);
    }
    free(scratch);
}

static void latencies(const bf_field *field, int structure)
{
    static const double share[5] = {0.5, 0.9, 0.99, 0.999, 0.9999};
    static const char *name[5] = {"50", "90", "99", "99.9", "99.99"};
    double *ns = (double *)malloc(LATENCIES * sizeof(double)), gradient[3], distance = 0;
    int n, who;
    if (!ns) return;
    for (who = 0; who < 3; who++) {
        for (n = 0; n < LATENCIES; n++) {
            const double *point = points + 3 * (n % COUNT);
            double phase = phases[n % COUNT], start = now_ns();
            if (who == 0) bf_distance(field, structure, point, phase, &distance, gradient);
            if (who == 1) distance = trilinear(field, structure, point, phase, gradient);
            ns[n] = now_ns() - start;
            sink = distance;
        }
        qsort(ns, LATENCIES, sizeof(double), by_size);
        for (n = 0; n < 5; n++)
            printf("latency of one call, %s %%\t%s\t%.0f\n", name[n],
                   who == 0 ? "ours" : who == 1 ? "plain trilinear" : "the clock itself",
                   ns[(int)(share[n] * (LATENCIES - 1))]);
    }
    free(ns);
}

/* A tool near the surface at 60 phases: microseconds, and how often the field is asked. */
static void tool(const bf_field *field, const char *name, const bf_tool *shape, const double *middle)
{
    double us[60], force[3], pose[16] = {1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1};
    int n, asked = 0, all = 0;
    for (n = 0; n < 3; n++) pose[4 * n + 3] = middle[n];
    for (n = 0; n < 60; n++) {
        int again;
        double start = used_ns();
        for (again = 0; again < 20; again++)
            bf_tool_force(field, 0, shape, pose, n / 60.0, 0.05, force, NULL, &asked);
        us[n] = (used_ns() - start) / 20000;
        all += asked;
        sink = force[0];
    }
    qsort(us, 60, sizeof(double), by_size);
    printf("tool\t%s, us (median of 60 phases)\t%.2f\n", name, us[30]);
    printf("tool\t%s, us (slowest phase)\t%.2f\n", name, us[59]);
    printf("tool\t%s, questions\t%.0f\n", name, all / 60.0);
    printf("tool\t%s, Hz\t%.0f\n", name, 1e6 / us[30]);
}

/* Where the first fixture's surface crosses a line along x through the grid's middle. */
static void on_the_surface(const bf_field *field, double *middle)
{
    double distance = -1;
    int axis;
    for (axis = 0; axis < 3; axis++)
        middle[axis] = field->origin_mm[axis] + 0.5 * field->spacing_mm[axis] * (field->shape[axis] - 1);
    for (; distance < 0; middle[0] += 0.1)
        bf_distance(field, field->fixture[0].structure, middle, 0.3, &distance, NULL);
}

static void tools(const bf_field *field)
{
    static double ring[48 * 3], line[(PIECES + 1) * 3];
    double middle[3], turn = 6.283185307179586;
    bf_tool shape;
    int n;
    memset(&shape, 0, sizeof shape);
    on_the_surface(field, middle);
    for (n = 0; n < 48; n++) {
        ring[3 * n] = 10 * cos(turn * n / 48);
        ring[3 * n + 1] = 10 * sin(turn * n / 48);
    }
    for (n = 0; n <= PIECES; n++) {
        line[3 * n] = 20 * cos(turn * n / PIECES * 1.5);
        line[3 * n + 1] = 20 * sin(turn * n / PIECES);
        line[3 * n + 2] = 60.0 * n / PIECES - 30;
    }
    shape.points_mm = ring;
    shape.count = 48;
    shape.closed = 1;
    tool(field, "torus of 2 cm", &shape, middle);
    shape.points_mm = line;
    shape.count = PIECES + 1;
    shape.closed = 0;
    tool(field, "line of 1000 pieces", &shape, middle);
}

int main(int count, char **words)
{
    bf_field field;
    int structure = 0;
    bf_status status = count > 1 ? bf_open(&field, words[1]) : BF_CANNOT_READ;
    if (status != BF_OK) {
        fprintf(stderr, "%s\n", bf_text(status));
        return 2;
    }
    bf_lock(&field);
    points = (double *)malloc(3 * COUNT * sizeof(double));
    phases = (double *)malloc(COUNT * sizeof(double));
    answers = (double *)malloc(4 * COUNT * sizeof(double));
    if (!points || !phases || !answers) return 2;
    on_a_path(&field);
    compare(&field, structure, "C, coherent path");
    with_scratch(&field, structure, "C, coherent path");
    latencies(&field, structure);
    at_random(&field, 1);
    compare(&field, structure, "C, random places at one phase");
    with_scratch(&field, structure, "C, random places at one phase");
    at_random(&field, 0);
    compare(&field, structure, "C, random places and phases");
    with_scratch(&field, structure, "C, random places and phases");
    tools(&field);
    bf_close(&field);
    free(points);
    free(phases);
    free(answers);
    return 0;
}
