/* Batches of beatfield.h against its single calls, bit for bit: questions from standard input
 * (x, y, z, phase as doubles), distance and gradient of the first structure to standard output.
 * With a second argument the questions are random: they must be sorted where they are many. */
#define BEATFIELD_IMPLEMENTATION
#include "beatfield.h"

static int same(const double *a, const double *b, size_t count)
{
    return memcmp(a, b, count * sizeof(double)) == 0;
}

static int compare(const bf_field *field, size_t count, const double *points, const double *phases,
                   size_t phase_count, double *scratch, double *room)
{
    double *distances = room, *gradients = room + count, one[3] = {0, 0, 0}, distance = 0;
    size_t n;
    int failed = 0;
    memset(room, 0xff, 4 * count * sizeof(double));
    if (scratch) memset(scratch, 0xff, BF_SCRATCH * count * sizeof(double));
    failed |= bf_distances(field, 0, count, points, phases, phase_count, distances, gradients,
                           scratch) != BF_OK;
    for (n = 0; n < count; n++) {
        failed |= bf_distance(field, 0, points + 3 * n, phases[phase_count == 1 ? 0 : n], &distance,
                              one) != BF_OK;
        failed |= !same(&distance, distances + n, 1) || !same(one, gradients + 3 * n, 3);
    }
    failed |= bf_forces(field, 0, count, points, phases, phase_count, gradients, scratch) != BF_OK;
    for (n = 0; n < count; n++) {
        failed |= bf_force(field, 0, points + 3 * n, phases[phase_count == 1 ? 0 : n], one) != BF_OK;
        failed |= !same(one, gradients + 3 * n, 3);
    }
    return failed;
}

/* Whether the scratch room was used, which is filled with 0xff before. */
static int used(const double *scratch)
{
    return memcmp(scratch, "\xff\xff\xff\xff\xff\xff\xff\xff", sizeof(double)) != 0;
}

/* Random questions are sorted; the same number of questions about one place are not. */
static int sorting(const bf_field *field, size_t count, double *points, double *phases, double *scratch, double *room)
{
    size_t n;
    int failed = compare(field, count, points, phases, count, scratch, room);
    failed |= used(scratch) != (count >= 1024);
    for (n = 1; n < count; n++) {
        memcpy(points + 3 * n, points, 3 * sizeof(double));
        phases[n] = phases[0];
    }
    failed |= compare(field, count, points, phases, count, scratch, room);
    return failed | used(scratch);
}

int main(int words, char **word)
{
    enum { MOST = 4096 };
    static double points[3 * MOST], phases[MOST], room[4 * MOST], q[4];
    static double scratch[BF_SCRATCH * MOST];
    double bad[3] = {0, INFINITY, 0};
    size_t count = 0;
    bf_field field;
    int failed;
    if (words < 2 || bf_open(&field, word[1]) != BF_OK) return 2;
    while (count < MOST && fread(q, sizeof(double), 4, stdin) == 4) {
        memcpy(points + 3 * count, q, 3 * sizeof(double));
        phases[count++] = q[3];
    }
    failed = compare(&field, count, points, phases, 1, NULL, room);
    failed |= compare(&field, count, points, phases, 1, scratch, room);
    failed |= compare(&field, count, points, phases, count, NULL, room);
    failed |= compare(&field, count, points, phases, count, scratch, room);
    failed |= bf_distances(&field, 0, 1, bad, phases, 1, room, room + 1, scratch) != BF_NOT_FINITE;
    failed |= bf_distances(&field, 0, count, points, phases, 2, room, room + 1, NULL) != BF_WRONG_SIZE;
    failed |= bf_distances(&field, 99, 1, points, phases, 1, room, room + 1, NULL) != BF_NO_SUCH_NAME;
    failed |= bf_distances(&field, 0, 0, NULL, phases, 1, NULL, NULL, scratch) != BF_OK;
    bf_distances(&field, 0, count, points, phases, count, room, room + count, scratch);
    fwrite(room, sizeof(double), 4 * count, stdout);
    if (words > 2) failed |= sorting(&field, count, points, phases, scratch, room);
    bf_close(&field);
    return failed;
}
