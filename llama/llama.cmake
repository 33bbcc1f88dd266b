# What llama.cpp's build leaves out here and how it is grouped: read at the end of its project() call, by CMAKE_PROJECT_INCLUDE in
# .cargo/config.toml. The binding crate asks for llama.cpp's common library, which nothing in Roomcast links, and compiles the 150
# sources of the model architectures one by one, each with the same headers.
if(PROJECT_NAME STREQUAL "llama.cpp")
    set(LLAMA_BUILD_COMMON OFF CACHE BOOL "not linked by Roomcast" FORCE)
    cmake_language(DEFER CALL set_target_properties llama PROPERTIES UNITY_BUILD ON UNITY_BUILD_BATCH_SIZE 24)
endif()
