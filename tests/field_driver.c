/* What the tests of beatfield.h drive: questions from standard input, answers to standard output,
 * all as doubles. */
#define BEATFIELD_IMPLEMENTATION
#include "beatfield.h"
#include <locale.h>

/* FIELD: x y z phase -> per fixture force, distance, gradient, potential */
static int ask(const bf_field *field)
{
    double q[4], answer[8];
    int n;
    while (fread(q, sizeof(double), 4, stdin) == 4)
        for (n = 0; n < field->fixtures; n++) {
            if (bf_force(field, n, q, q[3], answer) != BF_OK ||
                bf_distance(field, field->fixture[n].structure, q, q[3], answer + 3, answer + 4) != BF_OK ||
                bf_potential(field, n, q, q[3], answer + 7) != BF_OK)
                return 1;
            fwrite(answer, sizeof(double), 8, stdout);
        }
    return 0;
}

/* FIELD contains: points -> 1 or 0 */
static int contains(const bf_field *field)
{
    double q[3], answer;
    while (fread(q, sizeof(double), 3, stdin) == 3) {
        answer = bf_contains(field, q);
        fwrite(&answer, sizeof(double), 1, stdout);
    }
    return 0;
}

/* FIELD tool BOUND COUNT CLOSED: the tool's points first, then a transform and a phase each ->
 * force, torque and evaluations */
static int feel(const bf_field *field, double bound_n, int count, int closed)
{
    double *points = (double *)malloc((size_t)count * 3 * sizeof(double)), q[17], answer[7];
    bf_tool tool;
    int n, evaluations, failed = !points || fread(points, sizeof(double), (size_t)count * 3, stdin) == 0;
    tool.points_mm = points;
    tool.count = count;
    tool.closed = closed;
    tool.handle_mm[0] = tool.handle_mm[1] = 0;
    tool.handle_mm[2] = 100;
    while (!failed && fread(q, sizeof(double), 17, stdin) == 17)
        for (n = 0; n < field->fixtures; n++) {
            failed |= bf_tool_force(field, n, &tool, q, q[16], bound_n, answer, answer + 3,
                                    &evaluations) != BF_OK;
            answer[6] = evaluations;
            fwrite(answer, sizeof(double), 7, stdout);
        }
    free(points);
    return failed;
}

/* FIELD tank LEVEL CAPACITY: point and wanted force -> rendered force and level */
static int tank(double level_mj, double capacity_mj)
{
    double q[6];
    bf_tank held = bf_full_tank(level_mj, capacity_mj);
    while (fread(q, sizeof(double), 6, stdin) == 6) {
        bf_pass(&held, q, q + 3);
        fwrite(q + 3, sizeof(double), 3, stdout);
        fwrite(&held.level_mj, sizeof(double), 1, stdout);
    }
    return 0;
}

/* Whether a force that a server might render by mistake is none; then it is made stale again. */
static int nothing(double force[3])
{
    int none = force[0] == 0 && force[1] == 0 && force[2] == 0;
    force[0] = force[1] = force[2] = 9;
    return none;
}

static int refuse(const bf_field *field)
{
    double point[3] = {0, 0, 0}, bad[3] = {0, NAN, 0}, force[3] = {9, 9, 9}, phases[2] = {0, 0};
    bf_tool none = {NULL, 0, 0, {0, 0, 0}};
    double identity[16] = {1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1};
    return !(bf_force(field, -1, point, 0, force) == BF_NO_SUCH_NAME && nothing(force) &&
             bf_force(field, field->fixtures, point, 0, force) == BF_NO_SUCH_NAME &&
             bf_force(field, 0, bad, 0, force) == BF_NOT_FINITE && nothing(force) &&
             bf_force(field, 0, point, INFINITY, force) == BF_NOT_FINITE && nothing(force) &&
             bf_distance(field, 99, point, 0, force, NULL) == BF_NO_SUCH_NAME &&
             bf_forces(field, 0, 1, point, phases, 2, force, NULL) == BF_WRONG_SIZE && nothing(force) &&
             bf_tool_force(field, 0, &none, identity, 0, 0.1, force, NULL, NULL) == BF_WRONG_SIZE && nothing(force) &&
             bf_structure(field, "none") == -1 && bf_fixture(field, "") == -1);
}

int main(int count, char **words)
{
    bf_field field;
    bf_status status;
    int failed = 0;
    /* A comma for a decimal point in the user's locale must not matter. */
    setlocale(LC_ALL, "");
    if (count > 2 && strcmp(words[2], "verify") == 0) {
        status = bf_verify(words[1]);
        printf("%s\n", bf_text(status));
        return (int)status;
    }
    status = bf_open(&field, words[1]);
    if (status != BF_OK) {
        printf("%s\n", bf_text(status));
        return (int)status;
    }
    if (count > 5) failed = feel(&field, atof(words[3]), atoi(words[4]), atoi(words[5]));
    else if (count > 4) failed = tank(atof(words[3]), atof(words[4]));
    else if (count > 2 && strcmp(words[2], "refuse") == 0) failed = refuse(&field);
    else if (count > 2 && strcmp(words[2], "lock") == 0) failed = bf_lock(&field) == BF_CANNOT_READ;
    else if (count > 2 && strcmp(words[2], "contains") == 0) failed = contains(&field);
    else failed = ask(&field);
    bf_close(&field);
    bf_close(&field);
    return failed ? 100 : 0;
}
