/* Ask a baked field for the force at a point, as `beatfield query` does, and outside the grid, too.
 *
 *     cc -O2 -I "$(python -c 'from pipeline.field import get_include; print(get_include())')" \
 *        docs/examples/query.c -o query -lm
 *     ./query OUT/patient-0001/bake/field.zarr 12.5 -30 41 0.35
 */
#define BEATFIELD_IMPLEMENTATION
#include "beatfield.h"

/* A word that is a number and nothing else; not a number (which the field refuses) otherwise. */
static double number(const char *word)
{
    char *end;
    double value = strtod(word, &end);
    return end > word && !*end ? value : NAN;
}

int main(int count, char **words)
{
    bf_field field;
    double point_mm[3], phase, distance_mm, potential, force_n[3];
    bf_status status;
    int n;
    if (count != 6) {
        fprintf(stderr, "use: %s FIELD X Y Z PHASE (LPS mm, share of the heartbeat)\n", words[0]);
        return 2;
    }
    status = bf_open(&field, words[1]);
    if (status != BF_OK) {
        fprintf(stderr, "error: %s: %s\n", words[1], bf_text(status));
        return 2;
    }
    for (n = 0; n < 3; n++) point_mm[n] = number(words[2 + n]);
    phase = number(words[5]);
    if (!(fabs(phase) < 10)) {
        fprintf(stderr, "error: phase %s is no share of the heartbeat, 0 to 1\n", words[5]);
        return 2;
    }
    for (n = 0; n < field.fixtures && status == BF_OK; n++) {
        const bf_fixture_part *law = &field.fixture[n];
        status = bf_distance(&field, law->structure, point_mm, phase, &distance_mm, NULL);
        if (status == BF_OK) status = bf_potential(&field, n, point_mm, phase, &potential);
        if (status == BF_OK) status = bf_force(&field, n, point_mm, phase, force_n);
        if (status == BF_OK)
            printf("%s: distance %.9g mm, potential %.9g, force %.9g %.9g %.9g N%s\n", law->name,
                   distance_mm, potential, force_n[0], force_n[1], force_n[2],
                   bf_contains(&field, point_mm) ? "" : " (outside the grid)");
    }
    bf_close(&field);
    if (status != BF_OK) fprintf(stderr, "error: %s\n", bf_text(status));
    return status == BF_OK ? 0 : 2;
}
