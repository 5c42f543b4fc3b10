/* What a force server meets: `prog FIELD COMMAND`; what it finds is printed. */
#define BEATFIELD_IMPLEMENTATION
#include "beatfield.h"

/* Distances alone, a few and many, in order and at random, are those with gradients. */
static int without_gradients(const bf_field *field)
{
    enum { MANY = 5000 };
    static double points[3 * MANY], phases[MANY], with[MANY], gradients[3 * MANY], alone[MANY];
    static double scratch[BF_SCRATCH * MANY];
    unsigned state = 1;
    int n, way, same = 1;
    for (n = 0; n < 3 * MANY; n++) {
        state = state * 1664525u + 1013904223u;
        points[n] = (double)(state >> 8) / (1 << 24) * 80 - 40;
    }
    for (n = 0; n < MANY; n++) phases[n] = n * 0.37;
    for (way = 0; way < 4; way++) {
        size_t count = way % 2 ? 5 : MANY;
        double *room = way / 2 ? scratch : NULL;
        same &= bf_distances(field, 0, count, points, phases, count, with, gradients, room) == BF_OK;
        same &= bf_distances(field, 0, count, points, phases, count, alone, NULL, room) == BF_OK;
        same &= memcmp(with, alone, count * sizeof(double)) == 0;
    }
    points[0] = NAN;
    same &= bf_distances(field, 0, 5, points, phases, 5, alone, NULL, NULL) == BF_NOT_FINITE;
    return same && alone[0] == 0;
}

/* Lock, wait for a line on standard input while the files are spoilt, and ask again. */
static int locked(bf_field *field, bf_status lock)
{
    double point[3] = {9, 4, 2}, before[3], after[3];
    int n, same = lock == BF_OK || lock == BF_CANNOT_LOCK;
    bf_force(field, 0, point, 0.3, before);
    printf("locked\n");
    fflush(stdout);
    same &= getchar() != EOF;
    for (n = 0; n < field->phases; n++)
        same &= bf_force(field, 0, point, field->phase[n] + 0.3, after) == BF_OK;
    same &= bf_force(field, 0, point, 0.3, after) == BF_OK && memcmp(before, after, sizeof after) == 0;
    return same && (bf_lock(field) == lock);
}

static int tank_of_nonsense(void)
{
    const double wrong[][2] = {{50, 20}, {-5, 20}, {NAN, 20}, {5, NAN}, {5, -1}};
    const double held[] = {20, 0, 0, 0, 0};
    double here[3] = {0, 0, 0}, there[3] = {1, 0, 0}, push[3] = {2, 0, 0}, bad[3] = {NAN, 0, 0};
    double beyond[3] = {0, 0, 0};
    bf_tank tank;
    int n, fine = 1;
    for (n = 0; n < 5; n++) {
        tank = bf_full_tank(wrong[n][0], wrong[n][1]);
        fine &= tank.level_mj == held[n];
    }
    tank = bf_full_tank(1, 20);
    bf_pass(&tank, here, push);
    bf_pass(&tank, bad, push);
    fine &= push[0] == 0;
    bf_pass(&tank, here, bad);
    fine &= bad[0] == 0 && tank.level_mj == 1;
    push[0] = 2;
    bf_pass(&tank, there, push);
    fine &= push[0] == 1 && tank.level_mj == 1;
    /* A number that is one, but so large that squares of it are none, is no place either. */
    beyond[1] = -1e308;
    push[0] = 2;
    bf_pass(&tank, beyond, push);
    fine &= push[0] == 0 && push[1] == 0;
    bad[0] = 1e308;
    bf_pass(&tank, there, bad);
    return fine && bad[0] == 0 && tank.level_mj == 1;
}

/* What a field that is not open says: nothing is in it, and nothing was locked. */
static int closed(const char *no_field)
{
    double origin[3] = {0, 0, 0}, force[3] = {9, 9, 9};
    double pose[16] = {1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1};
    bf_tool point = {NULL, 1, 0, {0, 0, 0}};
    bf_field field;
    int fine = bf_open(&field, no_field) != BF_OK;
    point.points_mm = origin;
    fine &= !bf_contains(&field, origin) && bf_outside_share(&field, &point, pose) == 1;
    fine &= bf_force(&field, 0, origin, 0, force) == BF_NO_SUCH_NAME && force[0] == 0;
    return fine && bf_lock(&field) == BF_NOT_A_FIELD && !field.copied;
}

int main(int count, char **words)
{
    bf_field field;
    const char *command = count > 2 ? words[2] : "";
    bf_status status = count > 1 ? bf_open(&field, words[1]) : BF_CANNOT_READ;
    double point[3] = {9, 4, 2}, out[3];
    if (status != BF_OK) {
        printf("%s\n", bf_text(status));
        return 3;
    }
    if (!strcmp(command, "patient")) printf("%s, %d doubts\n", field.patient_id, field.doubts);
    else if (!strcmp(command, "gradients")) printf("%d\n", without_gradients(&field));
    else if (!strcmp(command, "lock")) printf("%d\n", locked(&field, bf_lock(&field)));
    else if (!strcmp(command, "tank")) printf("%d\n", tank_of_nonsense());
    else if (!strcmp(command, "closed")) printf("%d\n", closed("no such folder"));
    else if (!strcmp(command, "tracker")) {
        bf_transform(field.mr_from_tracker, point, out);
        status = bf_force(&field, 0, out, 0.3, point);
        printf("%d %d\n", field.registered, status);
        bf_turn_back(field.mr_from_tracker, out, out);
        printf("%.17g %.17g %.17g\n", out[0], out[1], out[2]);
    } else if (!strcmp(command, "long")) {
        double line[6] = {0, 0, 0, 0, 0, 0}, torque[3];
        double pose[16] = {1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1};
        bf_tool needle = {NULL, 2, 0, {0, 0, 0}};
        needle.points_mm = line;
        while (scanf("%lf", &line[5]) == 1)
            printf("%d\n", bf_tool_force(&field, 0, &needle, pose, 0, 0.05, out, torque, NULL));
    } else if (!strcmp(command, "outside")) {
        double line[12] = {0, 0, 0, 5, 0, 0, 5, 40, 0, 5, 40, -70}, pose[16];
        bf_tool bent = {NULL, 4, 0, {0, 0, 0}};
        int n = 0;
        bent.points_mm = line;
        while (scanf("%lf", &pose[n % 16]) == 1) {
            if (++n % 16) continue;
            bent.count = 4;
            bent.closed = 0;
            printf("%.17g ", bf_outside_share(&field, &bent, pose));
            bent.closed = 1;
            printf("%.17g ", bf_outside_share(&field, &bent, pose));
            bent.count = 1;
            printf("%.17g\n", bf_outside_share(&field, &bent, pose));
        }
    } else if (!strcmp(command, "nowhere")) {
        /* A line within the grid of which one number is none. */
        double pose[16] = {1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1};
        int n;
        for (n = 0; n < 27; n++) {
            double line[9] = {0, 0, 0, 0, 0, 5, 0, 0, 9};
            bf_tool spoilt = {NULL, 3, 0, {0, 0, 0}};
            spoilt.points_mm = line;
            line[n % 9] = n < 9 ? NAN : n < 18 ? INFINITY : -INFINITY;
            printf("%.17g\n", bf_outside_share(&field, &spoilt, pose));
        }
    } else if (!strcmp(command, "numbers")) {
        static char text[200000];
        bf__json j = {NULL, NULL, 0};
        j.at = text;
        j.end = text + fread(text, 1, sizeof text, stdin);
        for (bf__blank(&j); !j.bad && j.at < j.end; bf__blank(&j)) printf("%.17g\n", bf__number(&j));
        printf("%d\n", j.bad);
    } else if (!strcmp(command, "often")) {
        int n;
        for (n = 0; n < 24 && status == BF_OK; n++) {
            bf_close(&field);
            status = n % 2 ? bf_verify(words[1]) : BF_OK;
            if (status == BF_OK) status = bf_open(&field, words[1]);
        }
        printf("%s\n", bf_text(status));
    } else printf("opened\n");
    bf_close(&field);
    return 0;
}
