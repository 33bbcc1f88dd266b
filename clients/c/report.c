/* What the robot "robot" answers, in C: reads one message of `roomcast/v1/decision` from a file, and writes that its work is finished, a
 * message of `roomcast/v1/robot-report`, into another; both byte for byte as they lie in shared memory. A robot that does the work first
 * must not begin it for a decision with ROOMCAST_DECISION_FLAGS_OWED, but report what became of it. */
#include <stdio.h>
#include <string.h>
#include <time.h>

#include "check.h"
#include "roomcast.h"

static const char NAME[] = "robot";

/* A robot's number: the 64-bit FNV-1a of its name, never 0. */
static uint64_t number_of(const char *name) {
    uint64_t number = 0xcbf29ce484222325u;
    for (; *name != 0; name++) {
        number = (number ^ (uint8_t)*name) * 0x100000001b3u;
    }
    return number == 0 ? 1 : number;
}

static uint64_t now_ns(clockid_t clock) {
    struct timespec now;
    clock_gettime(clock, &now);
    return (uint64_t)now.tv_sec * 1000000000u + (uint64_t)now.tv_nsec;
}

/* What comes from another process is checked before it is believed. A probability that is no number fails both comparisons. */
static int is_sound(const RoomcastDecisionV1 *decision) {
    return decision->robot != 0 && decision->epoch != 0 && decision->sequence != 0 &&
           decision->action <= ROOMCAST_ACTION_PAUSE && decision->probability >= 0.0 && decision->probability <= 1.0 &&
           is_text(decision->from, sizeof decision->from) && is_text(decision->to, sizeof decision->to) &&
           is_text(decision->policy, sizeof decision->policy) && is_text(decision->robot_name, sizeof decision->robot_name) &&
           is_text(decision->reason, sizeof decision->reason);
}

int main(int argc, char **argv) {
    RoomcastDecisionV1 decision;
    FILE *from = argc == 3 ? fopen(argv[1], "rb") : NULL;
    if (from == NULL) {
        fprintf(stderr, "usage: report DECISION REPORT\n");
        return 2;
    }
    size_t bytes = fread(&decision, 1, sizeof decision, from);
    int more = fgetc(from) != EOF;
    fclose(from);
    if (bytes != sizeof decision || more || !is_sound(&decision)) {
        fprintf(stderr, "report: this is no %s\n", ROOMCAST_TYPE_NAME_DECISIONV1);
        return 1;
    }
    /* What was decided elsewhere is an order to no robot here. */
    int is_order = decision.robot == number_of(NAME) && (decision.flags & ROOMCAST_DECISION_FLAGS_ELSEWHERE) == 0;
    if (!is_order || decision.action != ROOMCAST_ACTION_GO) {
        fprintf(stderr, "report: this sends \"%s\" nowhere\n", NAME);
        return 1;
    }
    RoomcastRobotReportV1 report = {
        .robot = decision.robot,
        .epoch = now_ns(CLOCK_REALTIME), /* random enough per start of one robot */
        .sequence = 1,
        .reported_ns = now_ns(CLOCK_BOOTTIME),
        .reported_unix_ns = now_ns(CLOCK_REALTIME),
        .decision_epoch = decision.epoch,
        .decision_sequence = decision.sequence,
        .kind = ROOMCAST_REPORT_KIND_FINISHED,
        .battery = 0.8,
        .flags = ROOMCAST_REPORT_FLAGS_HAS_BATTERY,
    };
    memcpy(report.robot_name, NAME, strlen(NAME));
    memcpy(report.room, decision.to, sizeof report.room);
    FILE *to = fopen(argv[2], "wb");
    if (to == NULL || fwrite(&report, sizeof report, 1, to) != 1 || fclose(to) != 0) {
        fprintf(stderr, "report: cannot write %s\n", argv[2]);
        return 1;
    }
    printf("decision %llu is done\n", (unsigned long long)decision.sequence);
    return 0;
}
