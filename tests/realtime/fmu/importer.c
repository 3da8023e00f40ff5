/* An importing tool for FMUs of FMI 3.0 that knows nothing of Python: runs commands, prints results.

   importer LIBRARY TOKEN RESOURCES COMMAND...

init:T  step:T:H  set:REFERENCE:VALUE  switch:REFERENCE:0 or 1  get:REFERENCE  reset  version
kill    ends all processes that the library has started, by signal 9 */

#include <dlfcn.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/types.h>
#include <unistd.h>

#include "fmi3Functions.h"

static void log_message(fmi3InstanceEnvironment environment, fmi3Status status, fmi3String category,
                        fmi3String message) {
    printf("log %d %s: %s\n", status, category, message);
}

static void *find(void *library, const char *name) {
    void *function = dlsym(library, name);
    if (!function) {
        printf("no function %s\n", name);
        exit(3);
    }
    return function;
}

static void kill_children(void) {
    char path[64];
    snprintf(path, sizeof path, "/proc/self/task/%d/children", getpid());
    FILE *file = fopen(path, "r");
    int child;
    while (file && fscanf(file, "%d", &child) == 1) kill(child, SIGKILL);
    if (file) fclose(file);
    usleep(200000);
}

int main(int count, char **words) {
    setvbuf(stdout, NULL, _IONBF, 0);
    void *library = dlopen(words[1], RTLD_NOW | RTLD_LOCAL);
    if (!library) {
        printf("dlopen: %s\n", dlerror());
        return 2;
    }
    fmi3InstantiateCoSimulationTYPE *instantiate = find(library, "fmi3InstantiateCoSimulation");
    fmi3EnterInitializationModeTYPE *enter = find(library, "fmi3EnterInitializationMode");
    fmi3ExitInitializationModeTYPE *leave = find(library, "fmi3ExitInitializationMode");
    fmi3DoStepTYPE *step = find(library, "fmi3DoStep");
    fmi3GetFloat64TYPE *get = find(library, "fmi3GetFloat64");
    fmi3SetFloat64TYPE *set = find(library, "fmi3SetFloat64");
    fmi3SetBooleanTYPE *turn = find(library, "fmi3SetBoolean");
    fmi3ResetTYPE *reset = find(library, "fmi3Reset");
    fmi3FreeInstanceTYPE *release = find(library, "fmi3FreeInstance");
    fmi3GetVersionTYPE *version = find(library, "fmi3GetVersion");

    fmi3Instance rig = instantiate("rig", words[2], words[3], fmi3False, fmi3True, fmi3False,
                                   fmi3False, NULL, 0, NULL, log_message, NULL);
    if (!rig) {
        printf("no instance\n");
        return 0;
    }
    for (int at = 4; at < count; at++) {
        const char *word = words[at];
        double first = 0.0, second = 0.0;
        char name[16] = "";
        sscanf(word, "%15[a-z]:%lf:%lf", name, &first, &second);
        fmi3ValueReference reference = (fmi3ValueReference)first;
        fmi3Status status = fmi3OK;
        if (!strcmp(name, "init")) {
            status = enter(rig, fmi3False, 0.0, first, fmi3False, 0.0);
            if (status == fmi3OK) status = leave(rig);
        } else if (!strcmp(name, "step")) {
            fmi3Boolean event, end, early;
            double reached = 0.0;
            status = step(rig, first, second, fmi3True, &event, &end, &early, &reached);
        } else if (!strcmp(name, "set")) {
            status = set(rig, &reference, 1, &second, 1);
        } else if (!strcmp(name, "switch")) {
            fmi3Boolean on = second != 0.0;
            status = turn(rig, &reference, 1, &on, 1);
        } else if (!strcmp(name, "get")) {
            double value = 0.0;
            status = get(rig, &reference, 1, &value, 1);
            if (status == fmi3OK) printf("value %.17g\n", value);
        } else if (!strcmp(name, "reset")) {
            status = reset(rig);
        } else if (!strcmp(name, "kill")) {
            kill_children();
        } else if (!strcmp(name, "version")) {
            printf("version %s\n", version());
        } else {
            printf("unknown command %s\n", word);
            return 4;
        }
        printf("%s %d\n", name, status);
    }
    release(rig);
    dlclose(library);
    printf("end\n");
    return 0;
}
